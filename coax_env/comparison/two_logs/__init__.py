"""Two logs of one flight: what one says that the other does not, and since when.

difference.py   whether they are of one flight; what changes.json says of them
changes.py      the search for what changed: the idea, and how a set of changes is found
before.py       the log before under its model, with the derivatives in every number
coordinates.py  the numbers that may have changed, as moves in effective numbers
logs.py         the difference of the two logs' whitened innovations
trials.py       what a set of changes is worth
stated.py       sizes, intervals and evidence of what is stated
"""
