"""Simulated flights: maneuvers, the pilot who flies them, and what the sensors log."""
