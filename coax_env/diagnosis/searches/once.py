"""One search: noise and numbers of the model as given, then causes until none pays.

Where commands are late it is done again with a delay of the readings' own (estimation/helicopter.py),
if that is likelier: what was found beside a delay that is off by a part of a row may stand for that
part.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from scipy.optimize import minimize_scalar

from coax_env.diagnosis import late_readings
from coax_env.diagnosis.evidence import as_named
from coax_env.diagnosis.fits import (
    fitted,
    flown_errors,
    in_noise_from,
    noise_fitted,
    start,
    steadied,
)
from coax_env.diagnosis.onsets.changing import Changing
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.scores import cost
from coax_env.diagnosis.search import search
from coax_env.estimation.helicopter_noise import LEAST_READING_STD
from coax_env.estimation.prediction import mean_log_ratio
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Noise
from coax_env.estimation.whiteness import are_white, whiteness

MOST_MOVES = 3
"""Times that late readings are moved, each by the delay found with the rows before; ours."""
TURNS = 2
"""Of values and noise, before a search begins with causes of another problem; ours."""
READ_WITHIN = 0.02
"""Of a row, to which the delay of the commands that readings see is looked for; ours."""


@dataclass(frozen=True)
class Searched:
    """The model as given, with its own numbers refitted, and with causes; the quadratic at the last.

    problem: what was searched.
    coarse: whether readings were taken to be no finer than LEAST_READING_STD.
    changing: with what began or changed in flight, where that has been asked already.
    air_asked: whether it has been asked if runs have air of their own.
    """

    problem: Problem
    bare: Fit
    refitted: Fit
    fit: Fit
    quadratic: Quadratic
    coarse: bool = False
    changing: Changing | None = None
    air_asked: bool = False

    @property
    def cost(self) -> float:
        """Minus the log evidence of what was found [nats]."""
        return cost(self.problem, self.fit, self.quadratic)


def searched_once(problem: Problem, noise: Noise, coarse: bool = False) -> Searched:
    """One search, from the model as given on.

    Args:
        problem: what may be free. noise: levels to start from.
        coarse: whether levels of readings that are finer than a rigid body are held.
    """
    bare, refitted = as_given(problem, noise, coarse)
    problem.report("searching for causes")
    return searched_from(problem, bare, refitted, refitted, coarse)


def as_given(problem: Problem, noise: Noise, coarse: bool = False) -> tuple[Fit, Fit]:
    """The model as given, and with its own numbers refitted, each with its own noise.

    Args:
        problem, noise, coarse: as in `searched_once`.
    """
    problem.report("estimating gusts and noise of the model as given")
    bare = start(problem, noise, held=LEAST_READING_STD if coarse else ())
    problem.report("fitting the model's own parameters")
    return bare, _refitted(problem, bare)


def _refitted(problem: Problem, bare: Fit) -> Fit:
    return steadied(problem, noise_fitted(problem, fitted(problem, bare)))


def from_causes_of(best: Searched, other: Searched) -> Searched:
    """What was found, or what a search in its problem ends with from the causes of another one, where
    that is likelier: of many causes the way there decides.

    Args:
        best: from no cause. other: of another problem.
    """
    names = tuple(e for e in other.fit.active if e in best.problem.candidates)
    begun = as_named(best.problem, best.refitted, replace(other.fit, active=names))
    for _ in range(TURNS):
        begun = fitted(best.problem, noise_fitted(best.problem, begun))
    found = likelier(best, begun)
    best.problem.report(f"from the causes found so: {best.cost - found.cost:.1f} nats")
    return found


def given_with(found: Searched, values: Mapping[str, float], noise: Noise) -> tuple[Fit, Fit]:
    """As `as_given`, with some values as they were, in the readings and air that were found.

    Args:
        found: of a search. values: by name. noise: process levels to start from.
    """
    problem = found.problem
    begun = found.bare.noise.with_levels(noise.process)
    held = LEAST_READING_STD if found.coarse else ()
    bare = in_noise_from(problem, found.bare.at(values), begun, held)
    return bare, _refitted(problem, bare)


def searched_from(
    problem: Problem, bare: Fit, refitted: Fit, begin: Fit, coarse: bool = False
) -> Searched:
    """The search from a fit, and again where readings see late commands at their own delay.

    Args:
        problem, coarse: as in `searched_once`. bare, refitted: of `as_given`.
        begin: with what is found already.
    """
    fit, quadratic = search(problem, begin)
    late = _with_late_readings(problem, fit)
    if late is not None:
        problem = late  # without a delay it is as it was: `refitted` stays
        problem.report("searching again with readings that see late commands at their own delay")
        fit, quadratic = search(problem, refitted)
    problem, fit, quadratic = _with_readings_moved_back(problem, fit, quadratic)
    return Searched(problem, bare, refitted, fit, quadratic, coarse)


def _with_readings_moved_back(
    problem: Problem, fit: Fit, quadratic: Quadratic
) -> tuple[Problem, Fit, Quadratic]:
    """The search again with late readings where they belong, as long as their delay stays."""
    for _ in range(MOST_MOVES):
        moved = late_readings.moved_back(problem, fit)
        if moved is None:
            break
        problem.report("searching again with late readings where they belong")
        other, other_quadratic = search(*moved)
        if late_readings.delay_in(other.active) is None:
            break
        problem, fit, quadratic = moved[0], other, other_quadratic
    return problem, fit, quadratic


def likelier(best: Searched, found: Fit) -> Searched:
    """That, or what a search from something else ends with, where it is likelier.

    Errors of a sensor that last take up what is always wrong with it, where they are fitted first: a
    bias that every run has is eight errors alike.

    Args:
        best: from no cause. found: causes in the same problem.
    """
    if not found.active:
        return best
    fit, quadratic = search(best.problem, found)
    other = replace(best, fit=fit, quadratic=quadratic)
    return best if best.cost <= other.cost else other


def nothing_forgotten(best: Searched, found: Fit) -> Searched:
    """`likelier`, where the search ended without a cause that jitter was found beside.

    In jitter, which takes up a part of what it was fitted without, another cause may come first: a
    droop of the motors in the place of their lag, which no single step exchanges (**synthetic**).

    Args:
        best: from no cause. found: causes in the same problem, jitter in it.
    """
    return best if set(found.active) <= set(best.fit.active) else likelier(best, found)


def _with_late_readings(problem: Problem, fit: Fit) -> Problem | None:
    """The problem whose readings see late commands at their own delay, where that is likelier."""
    delay = fit.values.get("command_delay.time", 0.0)
    if delay <= 0.0 or problem.model.read_delay is not None:
        return None

    def read_after(seconds: float) -> Problem:
        return problem.with_model(problem.model.reading_after(seconds))

    row = problem.row
    best = minimize_scalar(
        lambda seconds: -read_after(seconds).engine.log_likelihood(fit.values, fit.noise),
        bounds=(max(delay - row, 0.0), delay + row), method="bounded",
        options={"xatol": READ_WITHIN * row},
    )  # fmt: skip
    late = read_after(float(best.x))
    trial = fitted(late, noise_fitted(late, fitted(late, fit)))
    return late if trial.objective < fit.objective - problem.settings.tie else None


def is_coloured(found: Searched, channels: Sequence[str]) -> bool:
    """Whether one of some channels is."""
    passes = found.problem.engine.filter(found.fit.values, found.fit.noise)
    shown = whiteness(passes, found.problem.model.channels)
    return not are_white(shown, channels)


def flies_nearer(found: Searched, other: Searched) -> bool:
    """Whether the open-loop errors of one on the fitted runs are smaller, by their geometric mean.

    Args:
        found, other: each with commands and readings as it takes them to be.
    """
    ours, theirs = (flown_errors(f.problem, f.fit) for f in (found, other))
    return mean_log_ratio(ours, theirs) < 0.0
