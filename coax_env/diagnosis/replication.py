"""Do the names return on parts of the flights? A search again on left-out runs and on halves.

The likelihood to second order is a sum over runs, so that of a part of them costs nothing: the names
are dropped and exchanged on the part's own quadratic, as in the search, and those that still stand have
returned.

A true cause shows everywhere that it could, so a part is asked for no more than its share of what is
known of the cause: with a share s of the information and a cause whose evidence of z^2 / 2 nats is
spread evenly, the part's own z is normal with mean sqrt(s) z and, given the whole, std sqrt(1 - s). A
cause that just passes the threshold therefore returns in 95 % of the parts; a name that other runs made
comes back by chance in 2 %. A part that knows too little of a cause to tell the two apart is not asked.

What stands in few runs is cut into pieces of time (each its own filter pass): halves are then halves of
every run.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from coax_env.diagnosis.problem import Fit, Problem, exclusive_with
from coax_env.diagnosis.scores import exchanges, lost
from coax_env.diagnosis.settings import Settings
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Record, part


@dataclass(frozen=True)
class Replication:
    """How a name fared on parts of the flights.

    Attributes:
        runs: share of left-out runs without which it returns.
        kept: share of the halves that could tell in which it returns; None where none could.
        rests_on: runs without which it does not return.
    """

    runs: float
    kept: float | None
    rests_on: tuple[str, ...]

    @classmethod
    def of(
        cls, names: Sequence[str], without: Sequence[bool | None], halved: Iterable[bool | None]
    ) -> "Replication":
        """Of what returned; None: a part could not tell.

        Args:
            names: of the runs. without: each of them. halved: on each half.
        """
        told = [returned for returned in halved if returned is not None]
        return cls(
            sum(map(bool, without)) / len(names),
            sum(told) / len(told) if told else None,
            tuple(name for name, returned in zip(names, without, strict=True) if not returned),
        )


def replications(
    problem: Problem, fit: Fit, quadratic: Quadratic, worth: Mapping[str, float]
) -> dict[str, Replication]:
    """Every active effect on left-out runs and on halves.

    Args:
        problem, fit: with the causes.
        quadratic: linearised at the fit, its runs in it.
        worth: evidence of each cause [nats].
    """
    if not fit.active:
        return {}
    runs = of_runs(problem.engine.records)
    known = Known.of(problem, fit, quadratic, worth)
    without = [
        _standing(problem, fit, known, quadratic.of_parts(_all_but(runs, out))) for out in runs
    ]
    whole, halves = _halves(problem, fit, quadratic)
    known = known if whole is quadratic else Known.of(problem, fit, whole, worth)
    halved = [_standing(problem, fit, known, whole.of_parts(half)) for half in halves]
    return {effect: _of_one(effect, list(runs), without, halved) for effect in fit.active}


def _of_one(
    effect: str,
    names: Sequence[str],
    without: Sequence[Mapping[str, bool | None]],
    halved: Sequence[Mapping[str, bool | None]],
) -> Replication:
    return Replication.of(
        names, [part[effect] for part in without], [part[effect] for part in halved]
    )


def of_runs(records: Sequence[Record]) -> dict[str, list[int]]:
    """Run -> indices of its records: a log with gaps is cut."""
    runs: dict[str, list[int]] = {}
    for i, record in enumerate(records):
        runs.setdefault(record.whole, []).append(i)
    return runs


def _all_but(runs: Mapping[str, Sequence[int]], out: str) -> list[int]:
    return [i for name, own in runs.items() if name != out for i in own]


# --- halves -----------------------------------------------------------------------------------------


def _halves(
    problem: Problem, fit: Fit, quadratic: Quadratic
) -> tuple[Quadratic, list[tuple[int, ...]]]:
    """The quadratic whose parts are halved, and the parts of each half."""
    chosen, records = problem.settings, problem.engine.records
    runs = list(of_runs(records).values())
    if len(runs) >= chosen.fewest_runs:
        halves = halves_of([range(len(runs))], chosen.splits)
        return quadratic, [tuple(i for k in half for i in runs[k]) for half in halves]
    pieces = [piece for record in records for piece in _pieces(record, chosen.piece_seconds)]
    engine = problem.with_records(pieces).engine
    _, lin = engine.linearise(fit.values, fit.noise, problem.parameters)
    groups = list(of_runs(pieces).values())
    whole = Quadratic.of(lin, problem.parameters, fit.values)
    return replace(whole, blocks=quadratic.blocks), list(halves_of(groups, chosen.splits))


def halves_of(groups: Sequence[Sequence[int]], splits: int) -> Iterator[tuple[int, ...]]:
    """Both halves of so many splits at random, every group halved; all splits where they are few.

    Args:
        groups: parts that are halved together: the runs, or the pieces of each run.
        splits: at most.
    """
    every = tuple(i for group in groups for i in group)
    if len(every) < 2:
        return
    rng = np.random.default_rng(0)
    if len(groups) == 1 and math.comb(len(every), len(every) // 2) <= 2 * splits:
        firsts = list(combinations(every, len(every) // 2))
        if len(every) % 2 == 0:  # the other half of one is another one
            firsts = firsts[: len(firsts) // 2]
    else:
        firsts = [_half_of_each(groups, rng) for _ in range(splits)]
    for first in firsts:
        yield first
        yield tuple(i for i in every if i not in first)


def _half_of_each(groups: Sequence[Sequence[int]], rng: np.random.Generator) -> tuple[int, ...]:
    """Half of every group; of an odd one the larger or the smaller half, by chance."""
    taken: list[int] = []
    for group in groups:
        count = (len(group) + int(rng.integers(2))) // 2
        taken += rng.permutation(list(group))[:count].tolist()
    return tuple(taken)


def _pieces(record: Record, seconds: float) -> list[Record]:
    """A record in pieces of about so many seconds."""
    count = max(1, round((record.t[-1] - record.t[0]) / seconds))
    edges = np.linspace(record.t[0], record.t[-1], count + 1)
    which = np.clip(np.searchsorted(edges, record.t, side="right") - 1, 0, count - 1)
    return [part(record, which == k) for k in range(count)]


# --- a search again on a part -----------------------------------------------------------------------


def _standing(
    problem: Problem,
    fit: Fit,
    known: "Mapping[str, Known]",
    of_part: Quadratic,
) -> dict[str, bool | None]:
    """Whether each name stands on a part of the flights; None where the part cannot tell.

    The weakest name is dropped, or exchanged for what explains it better, until all that is left
    stands. What left has its off-value from then on: held where it was fitted, it would still explain
    what it did, and two that stand for each other would be exchanged without end.
    """
    asked = {e: Asked.of(problem, fit, known[e], of_part) for e in fit.active}
    active = list(fit.active)
    seen: set[frozenset[str]] = set()
    while active:
        margins = {
            e: asked[e].margin(lost(problem, of_part, active, e)) if e in asked else math.inf
            for e in active
        }
        weakest = min(margins, key=lambda e: margins[e])
        if margins[weakest] < 0.0:
            active.remove(weakest)
            of_part = of_part.held_at(problem.off_values(weakest) | problem.file_values(weakest))
            continue
        exchange = _exchange(problem, of_part, active, [e for e in active if e in asked])
        if exchange is None:
            break
        seen.add(frozenset(active))
        old, new = exchange
        active[active.index(old)] = new
        if frozenset(active) in seen:
            break  # each for the other, by what a bound or Occam's factor makes of it
        of_part = of_part.held_at(
            problem.off_values(old) | problem.file_values(old) | problem.file_values(new)
        )
    result: dict[str, bool | None] = {}
    for effect, of_one in asked.items():
        stands = effect in active and same_way(problem, fit, of_part, active, effect)
        result[effect] = stands if of_one.can_tell else None
    return result


@dataclass(frozen=True)
class Known:
    """What the whole flights know of one cause.

    Attributes:
        effect: its name.
        information: on it [nats, doubled].
        lost: nats by the quadratic without it.
        worth: its evidence [nats].
    """

    effect: str
    information: float
    lost: float
    worth: float

    @classmethod
    def of(
        cls, problem: Problem, fit: Fit, whole: Quadratic, worth: Mapping[str, float]
    ) -> "dict[str, Known]":
        """That of every active effect.

        Args:
            problem, fit: with the causes.
            whole: linearised at the fit.
            worth: evidence of each cause [nats].
        """
        return {
            e: cls(
                e,
                information(problem, fit, whole, e),
                lost(problem, whole, fit.active, e),
                worth[e],
            )
            for e in fit.active
        }


@dataclass(frozen=True)
class Asked:
    """What a part of the flights is asked of one cause.

    Attributes:
        share: of the information on the cause that the part has, 1 at most.
        scale: nats of evidence per nat of the whole's quadratic.
        worth: evidence of the cause on the whole [nats].
        settings: what decides.
    """

    share: float
    scale: float
    worth: float
    settings: Settings

    @classmethod
    def of(
        cls,
        problem: Problem,
        fit: Fit,
        known: Known,
        of_part: Quadratic,
    ) -> "Asked":
        """What is asked of an active effect.

        Args:
            problem, fit: with the causes.
            known: of the effect, on the whole flights.
            of_part: linearised at the fit: a part, or a variation.
        """
        there = information(problem, fit, of_part, known.effect)
        share = min(there / known.information, 1.0) if known.information > 0.0 else 0.0
        scale = known.worth / known.lost if known.lost > 0.0 else 0.0
        return cls(share, scale, known.worth, problem.settings)

    def expected(self, nats: float) -> float:
        """The least z, in 95 of 100 cases, of a cause of so many nats spread evenly."""
        spread = self.settings.return_quantile * math.sqrt(max(1.0 - self.share, 0.0))
        return math.sqrt(2.0 * self.share * max(nats, 0.0)) - spread

    @property
    def can_tell(self) -> bool:
        """Whether the cause, spread evenly, would show here."""
        return self.expected(self.worth) >= self.settings.return_least

    @property
    def needed(self) -> float:
        """Evidence [nats] with which the name returns."""
        least = max(self.expected(self.settings.evidence), self.settings.return_least)
        return 0.5 * least**2

    def margin(self, lost: float) -> float:
        """Nats beyond what is needed, where so many are lost without the cause."""
        return self.scale * lost - self.needed


def information(problem: Problem, fit: Fit, quadratic: Quadratic, effect: str) -> float:
    """Nats, doubled, that an effect of its fitted size is expected to be worth, the rest refitted.

    Args:
        problem, fit: with the causes.
        quadratic: linearised at the fit.
        effect: an active one.
    """
    own = problem.acting_names(effect)
    free = set(problem.free_names(fit.active))
    rest = [n for n in free if not n.startswith(effect + ".")]
    off = problem.off_values(effect)
    size = np.array([fit.values[n] - off[n] for n in own])
    return float(size @ quadratic.projected(own, rest)[0] @ size)


def same_way(
    problem: Problem, fit: Fit, quadratic: Quadratic, active: Collection[str], effect: str
) -> bool:
    """Whether an effect's values on a part point where they do on the whole.

    Args:
        problem, fit, quadratic: of the whole. active: effects in the part's model.
        effect: whose values are asked.
    """
    _, move = quadratic.best(problem.free_names(active))
    moved, off = quadratic.moved(move), problem.off_values(effect)
    usual = {f.name: f.std for f in problem.own[effect]}
    along = sum(
        (moved[n] - off[n]) * (fit.values[n] - off[n]) / usual[n] ** 2
        for n in problem.acting_names(effect)
    )
    return along > 0.0


def _exchange(
    problem: Problem, quadratic: Quadratic, active: Sequence[str], names: Sequence[str]
) -> tuple[str, str] | None:
    """A name and what explains it better, the best such pair."""
    found = [
        (change, old, new)
        for change, old, new, _ in exchanges(problem, quadratic, active, names)
        if not exclusive_with(new) & {e for e in active if e != old}
    ]
    return min(found)[1:] if found else None
