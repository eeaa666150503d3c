"""CoaxHeli-v0: the Gymnasium environment, single and vectorised, on one compiled flight loop."""
