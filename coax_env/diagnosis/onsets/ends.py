"""The first and last moments of a flight, at which nothing begins."""

from collections.abc import Sequence

from coax_env.estimation.helicopter import Moment
from coax_env.estimation.state_space import Record

MARGIN = 1.5
"""s from the first row of all, and to the last, in which nothing begins: the filter settles in one, and
what lasts a second cannot be told from a gust; ours."""


def at_an_end(records: Sequence[Record], moment: Moment) -> bool:
    """Whether a moment is in the MARGIN from the first row of all, or to the last.

    Args:
        records: of all runs in their order. moment: when something begins.
    """
    first, last = records[0], records[-1]
    begins = moment.run == first.whole and moment.t < first.t[0] + MARGIN
    return begins or (moment.run == last.whole and moment.t > last.t[-1] - MARGIN)
