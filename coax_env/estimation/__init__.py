"""Filter, likelihood and sensitivities of a state-space model, and the helicopter as one.

What is asked of any model:

state_space.py       what the engine asks of a model; noise levels, free parameters, records
engine.py            filter, likelihood, derivatives, fits and noise scores of all records
run_passes.py        passes of the filter over single runs, and the memory that they work in
linearised_runs.py   one run's innovations differentiated in many parameters at once
quadratic.py         the log-posterior to second order: gains, covariances, Occam factors
noise_levels.py      noise levels of largest likelihood
whiteness.py         whether innovations are white
parted_engine.py     several flights under one set of numbers

The passes that are compiled:

compiled_model.py    a model's functions, their differences, flight without readings
pass_data.py         what passes are given, and what they leave
kalman.py            the extended Kalman filter
filter_arrays.py     the arrays that it works in
transition.py        its Jacobians, and which states any reading shows
frozen_gains.py      its mean with the gains held: the signatures of parameters
noise_score.py       the likelihood's slopes in the noise, by a pass back
beginnings.py        parameters that move from some row on, at every row at once
sparse.py            matrices that are mostly zero
compile_ahead.py     all of these compiled before a first diagnosis

The helicopter:

helicopter.py        the compiled kernel as such a model, its parameters with priors
helicopter_noise.py  its noise levels, with units, bounds and where they start
rotor_jitter.py      rotor speeds that jitter, with a memory
swinging_gusts.py    gusts with a frequency
late_readings.py     late readings at the rows to which they belong
low_pass.py          readings as they were before a sensor's low-pass
run_air.py           gusts of another strength and memory from run to run
gust_strength.py     gusts in single shocks: a strength for each block of time
changing_model.py    effects that begin, end or grow at a moment
flown.py             what of a flight was flown
prediction.py        its errors over a horizon, flown without readings
trajectories.py      where a machine was, and where the model would have put it
fitted_vehicle.py    a vehicle with the numbers that were fitted
freed_memory.py      what the C library keeps of freed memory
"""
