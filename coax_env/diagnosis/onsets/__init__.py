"""Does a cause begin, change or end while the machine flies, and when?

search.py        what stands out, is fitted, and pays; causes searched for beside it
every_moment.py  what a change is worth at every moment, by the quadratic
trial.py         one change, fitted; what it is worth beside models without it
moment.py        when it came, with its interval
growth.py        whether it came at once or grew
ends.py          the first and last moments, at which nothing begins
changing.py      the problem in which causes change; an onset
"""
