"""Filter, likelihood and sensitivities of a state-space model, and the helicopter as one."""
