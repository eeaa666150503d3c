"""Whether a log agrees with itself: signs, units and axes, and the line of its card to change."""
