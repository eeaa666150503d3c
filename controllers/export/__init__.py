"""Controllers as they leave the house: C99 for a flight computer, ONNX for a network."""
