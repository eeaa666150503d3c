"""What commands do between slow rows: held until the next, on the way to it, or changed at some time.

A log at 25 Hz has one command of four. Held until the next, each acts 15 ms late in the mean, which a
lag or a delay of the machine gives back: motor lags of 60 ms were identified as 49, 50 and 50 +- 0.4 ms
on three **synthetic** flights, and as 59.4, 60.1 and 60.1 since their mean is found. So a row's command
has in the mean a share of the next one's; and as it may change anywhere in the row, evenly, that mean
may have a variance of a twelfth of the change squared. Readings at the row's beginning see it as
written.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

from coax_env.estimation.engine import Engine
from coax_env.estimation.fitted_vehicle import median_step
from coax_env.estimation.late_commands import TIE
from coax_env.estimation.state_space import Noise, Record
from coax_env.progress import Progress

SLOWER = 0.015
"""s between rows from which it is asked: between 100 Hz, at which small machines are flown, and 50 Hz;
ours."""
ON_LINES = 0.5
"""Share of the next command in a row's where commands are on a straight line."""
EVENLY = 1.0 / 12.0
"""Variance of a share that may be anything from 0 to 1."""
SHARES = (0.125, 0.25, 0.375, ON_LINES)
"""That are tried: where one command of two is logged the mean has 0.25 of the next, of four 0.375, of
very many 0.5; an eighth is between."""


class Between(NamedTuple):
    """What commands are taken to do in a row; see Record.

    share: of the next one in the row's mean. variance: of that mean, in squares of the change.
    """

    share: float
    variance: float

    def __str__(self) -> str:
        when = ", changing at unknown times" if self.variance else ""
        return f"commands at {self.share:g} of the way to the next row's{when}"


HELD = Between(0.0, 0.0)
TRIED = tuple(Between(*of) for of in product((0.0, *SHARES), (0.0, EVENLY)))


def of_rows(records: Sequence[Record]) -> Between:
    """What the commands of records are taken to do, the same in all."""
    return Between(records[0].of_next, records[0].between)


def with_between(records: Sequence[Record], between: Between) -> list[Record]:
    """Records whose commands are so between the rows.

    Args:
        records: with commands as logged.
    """
    return [replace(r, of_next=between.share, between=between.variance) for r in records]


def likelihoods(engine: Engine, values: Mapping[str, float], noise: Noise) -> dict[Between, float]:
    """The log likelihood of each that is tried.

    Args:
        engine: model and records. values, noise: of the parameters, and levels.
    """

    def likelihood(of: Between) -> float:
        records = with_between(engine.records, of)
        return Engine(engine.model, records, engine.threads).log_likelihood(values, noise)

    return {of: likelihood(of) for of in TRIED}


def likeliest(
    engine: Engine, values: Mapping[str, float], noise: Noise, report: Progress
) -> Between:
    """What commands do by the likelihood alone, as they are taken to do within a tie; of slow rows.

    Args:
        engine: model and records. values, noise: of the parameters, and levels.
        report: called with a line of text.
    """
    now = of_rows(engine.records)
    if not median_step(engine.records) > SLOWER:
        return now
    nats = likelihoods(engine, values, noise)
    found = max(nats, key=lambda of: nats[of])
    gained = nats[found] - nats[now]
    if not gained > TIE:
        return now
    report(f"{found}: {gained:.1f} nats")
    return found


def next_larger(between: Between) -> Between:
    """With the next share that is tried; itself, of the largest.

    A lag that was fitted with a smaller one has taken a part of it up: on a **synthetic** flight at
    25 Hz with 60 ms shares of an eighth and a quarter are as likely at 49 ms, found with none.
    """
    larger = [share for share in SHARES if share > between.share]
    return between._replace(share=larger[0]) if larger else between


def remarks(between: Between) -> list[str]:
    """What was done between the rows, for who reads the findings."""
    said = []
    if between.share:
        said.append(
            "commands between the rows are taken to be, in the mean, at"
            f" {between.share:.3g} of the way from each to the next, which is likelier than that they"
            " are held"
        )
    if between.variance:
        said.append(
            "commands change between the rows, when is not known: rows in which they change much are"
            " believed less"
        )
    return said
