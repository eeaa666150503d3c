"""From the model as given to the causes found, and again with what the log has besides.

A search may leave innovations coloured, or name what another noise explains. So it is asked in this
order what the log has, and where it has that, the search is done again with it:

- what commands do between slow rows (slow_commands.py), before the first search, and after it
- commands that are written later than they act (estimation/late_commands.py)
- what moves the rotors, alone; rotor speeds that come late, or jitter (rotors.py): nothing else touches
  these readings
- air of each run's own (unrest.py): noise of one level makes many names
- wrong times of rows, where motion stays coloured; gyros and accelerometers that come late, or through
  low-passes, since errors that last would take a part of them up; errors that last (readings.py)
- shocks, swings, jitter that no rotor speed shows, joint gusts; last, readings believed less
  (unrest.py)

Where inertial sensors stay coloured behind a low-pass, errors are asked for in readings as logged, too,
and stand if that is likelier and has no name more: errors of every memory at once look like a low-pass.
Where they stay so in the end, the gusts as they are then are asked there, too: so does a swing.
"""

from collections.abc import Mapping

from coax_env.diagnosis.fits import is_much_coloured
from coax_env.diagnosis.problem import Problem
from coax_env.diagnosis.rotor_jitter import share_of
from coax_env.diagnosis.searches.once import (
    Searched,
    flies_nearer,
    is_coloured,
    searched_once,
)
from coax_env.diagnosis.searches.readings import (
    before_low_passes,
    behind_other_low_passes,
    lost,
    with_errors,
    with_imu_on_time,
    with_true_times,
)
from coax_env.diagnosis.searches.rotors import (
    is_lag_unshown,
    jittery,
    rotors_first,
    with_late_speeds,
)
from coax_env.diagnosis.searches.unrest import in_own_air, in_unrest
from coax_env.diagnosis.slow_commands import (
    are_held,
    from_reaction,
    held_after_all,
    likeliest_between,
    with_held,
)
from coax_env.estimation.changing_model import Lap
from coax_env.estimation.late_commands import written_late
from coax_env.estimation.state_space import Noise
from coax_env.model.layout import INERTIAL, ROTOR_SPEEDS


def searched(problem: Problem, noise: Noise, clock: Mapping[str, Lap]) -> Searched:
    """The search from a starting noise, and from a coarser one where that flies better.

    Args:
        problem: what may be free. noise: levels to start from.
        clock: of all runs in the order in which they were flown.
    """
    given = noise
    problem, first, noise = _between_rows(problem, given)
    late_by = commands_late(first)
    if late_by > 0.0:
        problem = problem.with_commands_sooner(late_by)
        problem.report("searching again with commands when they act")
        first, noise = _first(problem, given)
    late = with_late_speeds(problem, first.problem, first.fit, given)
    if late is None and (is_coloured(first, ROTOR_SPEEDS) or is_lag_unshown(first)):
        first, noise = jittery(first, noise)
        if is_coloured(first, ROTOR_SPEEDS):
            late = with_late_speeds(problem, first.problem, first.fit, given, coloured=True)
    if late is not None:
        first, noise = late, given
    first = with_true_times(in_own_air(first, noise), noise)
    smoothed = before_low_passes(first, noise)
    moved = with_imu_on_time(first, smoothed, noise)
    if moved is not None:
        first, smoothed = moved, before_low_passes(moved, noise)
    problem = first.problem
    of_smoothed = share_of(smoothed.fit, noise) if smoothed is not None else noise
    best, begun = with_errors(smoothed or first, of_smoothed, clock)
    erring = begun is not of_smoothed
    if smoothed is not None and is_coloured(best, INERTIAL):
        other, begun_so = with_errors(first, noise, clock)
        no_more = set(other.fit.active) <= set(best.fit.active)
        if other is not first and no_more and lost(problem, other) < lost(problem, best):
            best, begun, erring = other, begun_so, begun_so is not noise
    if erring and best.changing is None:
        best = behind_other_low_passes(problem, best, begun)
        begun = share_of(best.fit, begun)
    if best.changing is not None:
        return best
    found = in_unrest(best, begun, clock, erring)
    if found.problem.smoothed and not erring and is_coloured(found, INERTIAL):
        return _without_low_passes(first, found, noise, clock)
    return found


def _between_rows(problem: Problem, given: Noise) -> tuple[Problem, Searched, Noise]:
    """The problem with commands between slow rows as they are likeliest, and `_first` of that.

    Held where that is likelier beside what was found; or, where what is left is a model that lacks much
    and whose likelihood tells little, where the fitted runs are flown nearer so.

    Args:
        problem: with commands that are held. given: levels to start from.
    """
    problem = likeliest_between(problem, given)
    first, noise = _first(problem, given)
    if are_held(problem):
        return problem, first, noise
    likelier = held_after_all(first)
    if likelier is None and not is_much_coloured(first.problem, first.fit):
        return problem, first, noise
    held = likelier or with_held(problem)
    held.report("searching again with commands that are held between the rows")
    other, begun = _first(held, given)
    if likelier is None and not flies_nearer(other, first):
        return problem, first, noise
    return held, other, begun


def _first(problem: Problem, noise: Noise) -> tuple[Searched, Noise]:
    """The first search, and the levels that it started from."""
    first, begun = rotors_first(problem, noise) or (searched_once(problem, noise), noise)
    return from_reaction(first), begun


def commands_late(first: Searched) -> float:
    """Time by which commands are written later than they act [s], by the model as given, refitted.

    Args:
        first: the first search.
    """
    problem, refitted, chosen = first.problem, first.refitted, first.problem.settings
    return written_late(
        problem.engine, refitted.values, refitted.noise, problem.report,
        chosen.sure_evidence, chosen.tie,
    )  # fmt: skip


def _without_low_passes(
    first: Searched, found: Searched, noise: Noise, clock: Mapping[str, Lap]
) -> Searched:
    """The search in readings as logged, where that leaves nothing coloured and is likelier.

    Gusts that are not yet as they are look like a low-pass: with a frequency, one of 41 Hz of three
    accelerometers for 89 nats on a clean **synthetic** flight. Behind it their frequencies left these
    coloured, and were not used; as logged, they left nothing.

    Args:
        first: the search in readings as logged. found: behind low-passes, in whatever unrest there is.
        noise: levels to start from. clock: of all runs in the order in which they were flown.
    """
    other = in_unrest(first, noise, clock, erring=False)
    if is_coloured(other, INERTIAL) or lost(first.problem, other) > lost(first.problem, found):
        return found
    first.problem.report("gusts that are known leave nothing of the low-pass")
    return other
