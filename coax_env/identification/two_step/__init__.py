"""The paper's own identification, sections IV.C and V: filter, reconstruct the states, regress.

processing.py      the filters of IV.C and the paper's check of them
reconstruction.py  step 1: the Kalman filter of (46)-(57), the smoother, the flapping of (50)-(51)
regression.py      least squares and total least squares; what a set of regressors does not determine
modes.py           step 2: the coefficients of (64)-(69), and of the modes the paper leaves open
method.py          all of it on a flight, and what it makes of the vehicle
published.py       Table VIII as printed, and what the paper's own tables predict for it
"""
