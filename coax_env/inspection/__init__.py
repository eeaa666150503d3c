"""What a flight contains, what is wrong with it, and what can be learned from it."""
