"""From the model as given to the causes found: one search, and again with what a log has besides.

searched.py  all of it, in order
once.py      one search, from a starting noise to causes; what it found
rotors.py    what moves the rotors first; rotors that jitter; rotor speeds that come late
readings.py  times that are wrong, low-passes, errors that last
unrest.py    air of each run's own, shocks, swings, joint gusts; readings believed less
"""
