"""What to fly next: the maneuver that separates two causes, the flight that determines the numbers."""
