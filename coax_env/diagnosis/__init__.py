"""What the simulation gets wrong on measured flights, why, and what correcting it gains."""
