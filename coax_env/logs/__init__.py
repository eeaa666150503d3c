"""Measured flights: folders with a test card and CSVs, and other people's logs turned into them."""
