"""Innovations, likelihood and signatures of any state-space model; knows no helicopter.

A model comes in through the small protocol of model.py: a compiled step, a compiled measurement, a
table of parameters with priors. kalman.py makes the passes over the data, fit.py fits.
"""
