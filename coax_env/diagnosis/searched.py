"""From the model as given to the causes found, and again with readings believed less.

A likelihood that no model in reach makes white is spent on what happens within a few rows: with the
readings of a motion capture it prefers numbers that fit the last tenth of a millimetre and fly the
next second worse. So where innovations stay coloured and readings are finer than a rigid body is
(LEAST_READING_STD), the search is done again with readings no finer than that, then than
three times that, as long as the model's open-loop flight over the horizon comes nearer to the fitted
runs (the likelihood raised to a power less than 1, for a model that is wrong: Miller and Dunson 2019,
J. Am. Stat. Assoc. 114; from one step to output error, Ljung 1999, System Identification, ch. 8).

Where measured rotor speeds stay coloured, it is done again with rotors that jitter in the filter
(estimation/rotor_jitter.py), if these are worth more than a tie: after a search, since a motor's lag
colours them too and must be found as what it is, and first, since nothing else touches these readings.

Where these come late themselves (late_rotor_speeds.py) it is done without them.

Where motion stays coloured then, it is asked whether the times of the log's rows are wrong
(clock_errors.py), and the search done again with readings that are as good as these.

Where gyros or accelerometers are read through a low-pass (sensor_low_pass.py) it is done again, with
what was before it. This comes next: errors that last would take a part of it up. Where errors of
readings last (sensor_errors.py) it is done again with these in it; where inertial sensors stay coloured
behind a low-pass, without it too, and that stands if it is likelier and has no name more: errors of
every memory at once look like a low-pass. Low-passes are then fitted once more. What motors make of
jitter is asked anew for readings as they are then. Where inertial sensors stay coloured in the end,
with gusts as they are, readings as logged are asked in these gusts too: a swing looks like a low-pass.

Where runs have air of their own (run_air.py) it is done again in that: after the first search, since
noise of one level makes many names, and once more here.

Where gusts have a frequency it is done again with that in the filter (estimation/swinging_gusts.py), if
nothing is coloured then: what a model lacks may swing, too. Swings look like single shocks to a model
of gusts that fade, so they are asked first, and stand where no shocks are left. Jitter that the yaw
rate alone shows is asked then, by poses alone where anything is named, before strengths of single
shocks take it up, and gusts once more beside it.
Last it is asked whether gusts push and turn at once (joint_gusts.py). Both are asked only where little
of what is read is coloured, since what a model lacks looks like jitter and like such gusts, too: on a
real helicopter they had an arm of 0.7 m.

And where commands are late, by a delay of the readings' own (estimation/helicopter.py), if that is
likelier: what was found beside a delay that is off by a part of a row may stand for that part.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from coax_env.diagnosis.clock_errors import with_clock_errors
from coax_env.diagnosis.doubts import has_limit, sizes
from coax_env.diagnosis.fits import (
    fitted,
    in_noise_from,
    is_much_coloured,
    noise_fitted,
    start,
    steadied,
)
from coax_env.diagnosis.joint_gusts import in_joint_gusts
from coax_env.diagnosis.late_rotor_speeds import (
    LAG,
    behind_low_pass,
    come_late,
    with_less_lag,
    without_speeds,
)
from coax_env.diagnosis.onsets.changing import Changing
from coax_env.diagnosis.onsets.search import most_by_change, with_onsets
from coax_env.diagnosis.problem import OF_ROTORS, Fit, Problem
from coax_env.diagnosis.rotor_jitter import in_jitter, share_of, with_share_anew
from coax_env.diagnosis.run_air import with_own_air
from coax_env.diagnosis.scores import cost
from coax_env.diagnosis.search import added, search
from coax_env.diagnosis.sensor_errors import lasting_errors
from coax_env.diagnosis.sensor_low_pass import GROUPS, LIKE, hidden_behind, low_passes
from coax_env.diagnosis.shocks import in_shocks, only_shock, with_shocks
from coax_env.diagnosis.swings import with_other_swings, with_swings
from coax_env.estimation.changing_model import Lap
from coax_env.estimation.helicopter_noise import (
    JITTER_LEVEL,
    JITTER_MEMORY,
    JITTER_REACTION,
    JITTER_RETURN,
    LEAST_READING_STD,
)
from coax_env.estimation.low_pass import LowPass, before_low_pass
from coax_env.estimation.prediction import pooled_rms, replay_runs
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.rotor_jitter import with_jitter
from coax_env.estimation.state_space import Noise, Record
from coax_env.estimation.whiteness import are_white, correlation, is_white, whiteness
from coax_env.model.layout import INERTIAL, ROTOR_SPEEDS, RPM_PER_RAD_S

COARSENESS = (1.0, 3.0)
"""Times LEAST_READING_STD that readings are believed to at most, one search after the other; ours."""
JITTER = (JITTER_LEVEL, JITTER_MEMORY, JITTER_REACTION, JITTER_RETURN)
"""What is found of jitter before the search in it, and kept."""
STRAYING = 5.0
"""std by which neighbouring differences of rotor speeds from their commands must be alike; ours."""
SHOWN_BY = (*ROTOR_SPEEDS, "r")
"""Channels that a rotor's jitter colours."""
READ_WITHIN = 0.02
"""Of a row, to which the delay of the commands that readings see is looked for; ours."""
NEAR = 0.3
"""Share of what errors that last are worth that one change in flight must be by its score, to be asked
instead of them. On three flights with such errors the best change was worth 0.05 to 0.15 of them, and
asking took 64 s of 110; growth scores less than it is worth; ours."""
NEARLY = 0.1
"""Share of its time by which a low-pass must be another one for a further search; ours."""
FINER = 2.0
"""Times finer than LEAST_READING_STD that a channel must be for a second search; ours."""


@dataclass(frozen=True)
class Searched:
    """The model as given, with its own numbers refitted, and with causes; the quadratic at the last.

    problem: what was searched.
    coarse: whether readings were taken to be no finer than LEAST_READING_STD.
    changing: with what began or changed in flight, where that has been asked already.
    of_next: share of the next row's command in a row's, 0 where commands are held (slow_commands.py).
    air_asked: whether it has been asked if runs have air of their own.
    """

    problem: Problem
    bare: Fit
    refitted: Fit
    fit: Fit
    quadratic: Quadratic
    coarse: bool = False
    changing: Changing | None = None
    of_next: float = 0.0
    air_asked: bool = False

    @property
    def cost(self) -> float:
        """Minus the log evidence of what was found [nats]."""
        return cost(self.problem, self.fit, self.quadratic)


def searched(problem: Problem, noise: Noise, clock: Mapping[str, Lap]) -> Searched:
    """The search from a starting noise, and from a coarser one where that flies better.

    Args:
        problem: what may be free. noise: levels to start from.
        clock: of all runs in the order in which they were flown.
    """
    given = noise
    first, noise = _rotors_first(problem, noise) or (_searched(problem, noise), noise)
    late = _with_late_speeds(problem, first.problem, first.fit, given)
    if late is None and _is_coloured(first, ROTOR_SPEEDS):
        first, noise = _jittery(first, noise)
        if _is_coloured(first, ROTOR_SPEEDS):
            late = _with_late_speeds(problem, first.problem, first.fit, given, coloured=True)
    if late is not None:
        first, noise = late, given
    first = _with_clock_errors(_with_own_air(first, noise), noise)
    problem = first.problem
    smoothed = _before_low_passes(first, noise)
    of_smoothed = share_of(smoothed.fit, noise) if smoothed is not None else noise
    best, begun = _with_errors(smoothed or first, of_smoothed, clock)
    erring = begun is not of_smoothed
    if smoothed is not None and _is_coloured(best, INERTIAL):
        other, begun_so = _with_errors(first, noise, clock)
        no_more = set(other.fit.active) <= set(best.fit.active)
        if other is not first and no_more and _lost(problem, other) < _lost(problem, best):
            best, begun, erring = other, begun_so, begun_so is not noise
    if erring and best.changing is None:
        best = _behind_other_low_passes(problem, best, begun)
        begun = share_of(best.fit, begun)
    if best.changing is not None:
        return best
    found = _in_unrest(best, begun, clock, erring)
    if found.problem.smoothed and not erring and _is_coloured(found, INERTIAL):
        return _without_low_passes(first, found, noise, clock)
    return found


def _with_late_speeds(
    problem: Problem, beside: Problem, fit: Fit, noise: Noise, coloured: bool = False
) -> Searched | None:
    """The search where rotor speeds come late: with those before their low-pass, or without them.

    Without them where they come late beside what is found so, too.

    Args:
        problem: as given. beside: the same, or with rotors that jitter. fit: of `beside`, with what
            moves the rotors. noise: levels to start from.
        coloured: whether rotor speeds stay so with rotors that jitter.
    """
    others = with_less_lag(beside, fit)
    if others is None:
        return None
    asked = beside is problem and not coloured  # with rotors that jitter, it has been
    behind = behind_low_pass(problem, fit, others, noise) if asked else None
    if behind is not None:
        problem.report("searching with rotor speeds as they were before a low-pass")
        return _searched(behind, noise)
    if not come_late(others, coloured):
        return None
    problem.report("searching without the measured rotor speeds, which come late")
    found = _searched(without_speeds(problem), noise)
    own = {f.name: fit.values[f.name] for f in problem.own[LAG]}
    begun = replace(fit.at(found.fit.values).at(own), active=(*found.fit.rest(LAG), LAG))
    again = fitted(beside, begun)
    others = with_less_lag(beside, again)
    return found if others is not None and come_late(others, coloured) else None


def _with_clock_errors(first: Searched, noise: Noise) -> Searched:
    """The search with rows whose times are wrong, where they are; what was found, where not.

    Args:
        first: the search with times as logged. noise: levels to start from.
    """
    problem = with_clock_errors(first.problem, first.fit)
    if problem is None:
        return first
    problem.report("searching again with readings as good as the times of their rows")
    return _searched(problem, noise)


def _before_low_passes(first: Searched, noise: Noise) -> Searched | None:
    """The search with readings as they were before a low-pass, where there is one.

    Args:
        first: the search in readings as logged. noise: levels to start from.
    """
    problem = first.problem
    smoothed = low_passes(problem, first.fit, noise)
    if not smoothed:
        return None
    problem.report("searching again with readings as they were before a low-pass")
    return _searched_before(first, problem.engine.records, smoothed, noise)


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
    other = _in_unrest(first, noise, clock, erring=False)
    if _is_coloured(other, INERTIAL) or _lost(first.problem, other) > _lost(first.problem, found):
        return found
    first.problem.report("gusts that are known leave nothing of the low-pass")
    return other


def _searched_before(
    found: Searched, logged: Sequence[Record], passes: Mapping[str, LowPass], noise: Noise
) -> Searched:
    """The search with readings as they were before low-passes, for what can be told from these.

    Args:
        found: a search of the same problem. logged: readings as logged.
        passes: by channel. noise: levels to start from.
    """
    problem = found.problem
    asked = set(problem.candidates) - hidden_behind(passes, found.fit, problem)
    others = {c: own for c, own in problem.low_passes.items() if c not in INERTIAL}
    behind = replace(problem, low_passes=others).behind(passes, logged)
    begun = with_share_anew(behind, found.fit, noise)
    return _searched(behind.of_candidates(asked), begun)


def _with_errors(found: Searched, noise: Noise, clock: Mapping[str, Lap]) -> tuple[Searched, Noise]:
    """The search with errors of readings that last, where they do, and the levels that it started from.

    Args:
        found: without such errors. noise: levels that it started from.
        clock: of all runs in the order in which they were flown.
    """
    erring = lasting_errors(found.problem, found.fit, noise)
    if erring is None:
        return found, noise
    if not erring.whiten:
        left = replace(found.problem, errors_left=erring.gained)
        return replace(found, problem=left), noise
    changed = _white_since(found, clock, erring.gained)
    if changed is not None:
        return changed, noise
    erring.problem.report("searching again with errors of readings that last")
    begun = with_share_anew(erring.problem, erring.fit, erring.begun)
    return _likelier(_searched(erring.problem, begun), erring.fit), begun


def _behind_other_low_passes(problem: Problem, found: Searched, noise: Noise) -> Searched:
    """The search behind low-passes as they are beside errors that last, where that is likelier.

    Without such errors a low-pass takes a part of them up, or is not seen: then it is asked for where
    something is named that looks like it.

    Args:
        problem: as given. found: with errors that last. noise: levels that it started from.
    """
    behind = [
        group
        for group in GROUPS
        if found.problem.low_passes.keys() & set(group) or LIKE[group] in found.fit.active
    ]
    if not behind:
        return found
    logged = problem.engine.records
    passes = low_passes(found.problem.with_records(logged), found.fit, noise, behind)
    if _are_nearly(passes, _inertial(found.problem.low_passes)):
        return found
    problem.report("searching again with readings as they were before these low-passes")
    again = _searched_before(found, logged, passes, noise)
    return again if _lost(problem, again) < _lost(problem, found) else found


def _inertial(passes: Mapping[str, LowPass]) -> dict[str, LowPass]:
    """Low-passes of gyros and accelerometers alone."""
    return {channel: own for channel, own in passes.items() if channel in INERTIAL}


def _are_nearly(passes: Mapping[str, LowPass], others: Mapping[str, LowPass]) -> bool:
    """Whether low-passes, by channel, are the others to a share of their times."""
    if passes.keys() != others.keys():
        return False
    pairs = [(passes[channel], others[channel]) for channel in passes]
    return all(a.order == b.order and abs(a.time - b.time) < NEARLY * b.time for a, b in pairs)


def _lost(problem: Problem, found: Searched) -> float:
    """Cost of what was found to the readings as logged [nats].

    Args:
        problem: as given, with these.
    """
    channels = problem.model.channels
    passes = _inertial(found.problem.low_passes)
    back = (before_low_pass(r, channels, passes)[1] for r in problem.engine.records)
    return found.cost - sum(back)


def _in_unrest(best: Searched, noise: Noise, clock: Mapping[str, Lap], erring: bool) -> Searched:
    """Again with shocks, jitter, swings, readings believed less, where the first search asks for it.

    Args:
        best: of the first search. noise: levels to start from.
        clock: of all runs in the order in which they were flown.
        erring: whether readings have errors that last; readings are not believed less then.
    """
    best = _with_own_air(best, noise)
    shaken = in_shocks(best.problem, best.fit)
    if shaken:
        swung = _in_swings(best, noise)
        if swung is not None and not in_shocks(swung.problem, swung.fit):
            return swung
        best, noise = _with_jitter(best, noise)
        shaken = in_shocks(best.problem, best.fit)
    if shaken:
        best = _changed(best, clock) or _searched_in_shocks(best, noise)
    asked = None
    while best is not asked:
        asked = best
        swung = None if shaken else _in_swings(best, noise)
        if swung is not None:
            return swung
        best, noise = _with_jitter(best, noise)
    best = _with_joint_gusts(best, noise)
    if erring:
        return best
    problem = best.problem
    coarser = _coarser(best.fit.noise)
    passes = problem.engine.filter(best.fit.values, best.fit.noise)
    if not coarser or is_white(passes, problem.model.channels):
        return best
    reading = best.fit.noise.reading
    as_fitted = {c: reading[c] for c in LEAST_READING_STD if c in reading}  # they are held, too
    for factor in COARSENESS:
        problem.report("the innovations stay coloured: searching again with readings believed less")
        levels = as_fitted | {channel: factor * std for channel, std in coarser.items()}
        other = _searched(problem, noise.with_levels(levels), coarse=True)
        if not _flies_better(problem, other.fit, best.fit):
            break
        best = other
    return best


def _with_jitter(found: Searched, noise: Noise) -> tuple[Searched, Noise]:
    """As `_jittery`, where what is coloured or named asks for it."""
    asks = _is_coloured(found, SHOWN_BY) or _may_hide_jitter(found)
    return _jittery(found, noise) if asks else (found, noise)


def _with_own_air(found: Searched, noise: Noise) -> Searched:
    """The search in air of each run's own, where runs have such; what was found, where not.

    Args:
        found: in the same air on all runs. noise: levels that it started from.
    """
    own = None if found.air_asked else with_own_air(found.problem, found.fit)
    if own is None or is_much_coloured(*own):
        return replace(found, air_asked=True)
    problem, _ = own
    problem.report("searching again in air of each run's own")
    return _searched(problem, noise)


def _in_swings(found: Searched, noise: Noise) -> Searched | None:
    """The search in gusts that swing, where they do and nothing is coloured then.

    Args:
        found: in gusts that fade. noise: levels that it started from.
    """
    swinging = with_swings(found.problem, found.fit)
    if swinging is None:
        return None
    problem, levels = swinging
    problem.report("gusts have a frequency: searching again with that")
    other = _searched(problem, noise.with_levels(levels))
    again = with_other_swings(problem, other.fit)
    if again is not None:
        problem, levels = again
        problem.report("a gust has another frequency: searching again with that")
        likelier = _searched(problem, noise.with_levels(levels))
        other = likelier if likelier.cost < other.cost else other
    problem = other.problem
    passes = problem.engine.filter(other.fit.values, other.fit.noise)
    return other if is_white(passes, problem.model.channels) else None


def _changed(found: Searched, clock: Mapping[str, Lap]) -> Searched | None:
    """With what changed in flight, where that is what looks like one shock.

    A thrust that falls by a tenth is a jump of the force. A strength at its moment would believe the
    model less just there, and the change were worth nothing; so it is asked before there are any.

    Args:
        found: without strengths. clock: of all runs in the order in which they were flown.
    """
    problem = found.problem
    shock = only_shock(problem, found.fit)
    if shock is None:
        return None
    state = with_onsets(problem, found.fit, found.quadratic, found.refitted, clock, shock)
    if not state.onsets or in_shocks(state.problem, state.fit):
        return None
    return replace(found, changing=state)


def _searched_in_shocks(first: Searched, noise: Noise) -> Searched:
    """The search with a strength of the gusts for each block of time.

    First with strengths of the model without a cause, which take what a shock may be for one; then, if
    causes stand that, with strengths beside these. What a model lacks looks like shocks too, and
    strengths would believe it less just there: they must make its innovations white, or none are used.
    """
    problem = first.problem
    trial, with_causes = with_shocks(problem, first.fit)
    if not is_white(
        trial.engine.filter(with_causes.values, with_causes.noise), problem.model.channels
    ):
        return first
    problem.report("gusts come in single shocks: searching again with a strength for each")
    problem, _ = with_shocks(problem, first.refitted)
    best = _searched(problem, noise)
    if best.fit.active:
        problem.report("searching again with strengths beside what was found")
        problem, _ = with_shocks(best.problem, best.fit)
        best = _searched(problem, noise)
    return best


def _rotors_first(problem: Problem, noise: Noise) -> tuple[Searched, Noise] | None:
    """The search that begins with what moves the rotors, and levels it started from; None where
    measured rotor speeds show nothing that does.

    Jitter that these show plainly is in it at once: asked after a whole search, it costs another one.

    Args:
        problem: what may be free. noise: levels to start from.
    """
    if not _rotors_stray(problem):
        return None
    bare, refitted = _as_given(problem, noise)
    problem.report("searching for causes")
    rotors, quadratic = added(problem.of_candidates(OF_ROTORS), refitted)
    found = Searched(problem, bare, refitted, rotors, quadratic)
    if _is_coloured(found, ROTOR_SPEEDS):
        rotors = _in_noise_anew(problem, rotors, noise)
        found = replace(found, fit=rotors)
    coloured = _is_coloured(found, ROTOR_SPEEDS)
    late = _with_late_speeds(problem, problem, rotors, noise) if coloured else None
    if late is not None:
        return late, noise
    jittery = in_jitter(problem, rotors, quadratic) if coloured else None
    if jittery is None or rotors.objective - jittery[1].objective < problem.settings.clear:
        return _searched_from(problem, bare, refitted, rotors), noise
    begun = _with_levels_of_jitter(noise, *jittery)
    problem.report("searching with rotor speeds that jitter")
    return _nothing_forgotten(_searched(jittery[0], begun), jittery[1]), begun


def _in_noise_anew(problem: Problem, fit: Fit, noise: Noise) -> Fit:
    """The fit with noise levels from the first guess, where that ends likelier.

    They were fitted beside rotors that do not lag. Jitter stands for what they lack: beside a motor's
    lag of another form it seemed to be worth 3,898 nats, on a longer flight 77,839, where rotor speeds
    are white with a drift of the thrust (**synthetic**).

    Args:
        problem, fit: with what moves the rotors. noise: the first guess.
    """
    other = fitted(problem, in_noise_from(problem, fit, noise))
    other = fitted(problem, noise_fitted(problem, other))
    return other if other.objective < fit.objective else fit


def _rotors_stray(problem: Problem) -> bool:
    """Whether a measured rotor speed less its command has a memory."""
    channels = problem.model.channels
    for k, channel in enumerate(ROTOR_SPEEDS):
        for record in problem.engine.records:
            apart = record.z[:, channels.index(channel)] - RPM_PER_RAD_S * record.command[:, k]
            apart = apart[np.isfinite(apart)]
            if apart.size > 2:
                apart = apart - apart.mean()
                if correlation(apart[1:], apart[:-1]) * math.sqrt(apart.size) > STRAYING:
                    return True
    return False


def _searched(problem: Problem, noise: Noise, coarse: bool = False) -> Searched:
    bare, refitted = _as_given(problem, noise, coarse)
    problem.report("searching for causes")
    return _searched_from(problem, bare, refitted, refitted, coarse)


def _as_given(problem: Problem, noise: Noise, coarse: bool = False) -> tuple[Fit, Fit]:
    """The model as given, and with its own numbers refitted, each with its own noise."""
    problem.report("estimating gusts and noise of the model as given")
    bare = start(problem, noise, held=LEAST_READING_STD if coarse else ())
    problem.report("fitting the model's own parameters")
    return bare, steadied(problem, noise_fitted(problem, fitted(problem, bare)))


def _searched_from(
    problem: Problem, bare: Fit, refitted: Fit, begin: Fit, coarse: bool = False
) -> Searched:
    """The search from a fit, and again where readings see late commands at their own delay."""
    fit, quadratic = search(problem, begin)
    late = _with_late_readings(problem, fit)
    if late is not None:
        problem = late  # without a delay it is as it was: `refitted` stays
        problem.report("searching again with readings that see late commands at their own delay")
        fit, quadratic = search(problem, refitted)
    return Searched(problem, bare, refitted, fit, quadratic, coarse)


def _white_since(found: Searched, clock: Mapping[str, Lap], gained: float) -> Searched | None:
    """With what changed in flight, where that leaves nothing coloured: a gyro that drifts off once.

    Args:
        found: without errors that last, which would take that up.
        clock: of all runs in the order in which they were flown.
        gained: by those errors [nats]: not asked where no change comes near it.
    """
    if most_by_change(found.problem, found.fit, found.quadratic) < NEAR * gained:
        return None
    state = with_onsets(found.problem, found.fit, found.quadratic, found.refitted, clock)
    passes = state.problem.engine.filter(state.fit.values, state.fit.noise)
    if not state.onsets or not is_white(passes, state.problem.model.channels):
        return None
    return replace(found, changing=state)


def _nothing_forgotten(best: Searched, found: Fit) -> Searched:
    """`_likelier`, where the search ended without a cause that jitter was found beside.

    In jitter, which takes up a part of what it was fitted without, another cause may come first: a
    droop of the motors in the place of their lag, which no single step exchanges (**synthetic**).

    Args:
        best: from no cause. found: causes in the same problem, jitter in it.
    """
    return best if set(found.active) <= set(best.fit.active) else _likelier(best, found)


def _likelier(best: Searched, found: Fit) -> Searched:
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


def _is_coloured(found: Searched, channels: Sequence[str]) -> bool:
    """Whether one of some channels is."""
    passes = found.problem.engine.filter(found.fit.values, found.fit.noise)
    shown = whiteness(passes, found.problem.model.channels)
    return not are_white(shown, channels)


def _may_hide_jitter(found: Searched) -> bool:
    """Whether something is named where no reading would be coloured by rotors that jitter.

    Where what is read is much coloured all the same, the model lacks something else, which jitter would
    take up: of the first real helicopter 32 % of the error was removed then, not 51.
    """
    problem = found.problem
    unseen = problem.sees_poses_alone and problem.aboard.isdisjoint(ROTOR_SPEEDS)
    return unseen and bool(found.fit.active) and not is_much_coloured(problem, found.fit)


def _jittery(found: Searched, noise: Noise) -> tuple[Searched, Noise]:
    """The search with rotors that jitter, where that ends likelier, and levels it started from.

    Where no rotor speed is read and much is coloured in jitter, too, the model lacks something else: of
    the second real helicopter 55 % of the error was removed then, not 72.

    Args:
        found: with such rotors already, or without. noise: levels that it started from.
    """
    jittery = in_jitter(found.problem, found.fit, found.quadratic)
    if jittery is None:
        return found, noise
    wider, fit = jittery
    if found.problem.aboard.isdisjoint(ROTOR_SPEEDS) and is_much_coloured(wider, fit):
        return found, noise
    wider.report("searching again with rotor speeds that jitter")
    begun = _with_levels_of_jitter(noise, wider, fit)
    other = _nothing_forgotten(_searched(wider, begun), fit)
    gained = found.cost - other.cost
    wider.report(f"rotor speeds that jitter after the search: {gained:.1f} nats")
    return (other, begun) if gained > 0.0 else (found, noise)


def _with_levels_of_jitter(noise: Noise, wider: Problem, fit: Fit) -> Noise:
    """Levels to start from, with those of jitter as they were found."""
    of_jitter = {name: fit.noise.level(name) for name in JITTER}
    return with_jitter(noise, wider.model).with_levels(of_jitter)


def _with_joint_gusts(found: Searched, noise: Noise) -> Searched:
    """The search in gusts that push and turn at once, where it ends likelier.

    Not where it needs a name at the limit of what is believed: beside noise that channels have in
    common such gusts came with an accelerometer's bias of 0.75 m/s2 on a **synthetic** flight.

    Args:
        found: with such gusts already, or without. noise: levels that it started from.
    """
    if is_much_coloured(found.problem, found.fit):
        return found
    joint = in_joint_gusts(found.problem, found.fit)
    if joint is None:
        return found
    problem, fit = joint
    problem.report("searching again with gusts that push and turn at once")
    other = _likelier(_searched(problem, noise, found.coarse), fit)
    if not other.cost < found.cost or is_much_coloured(other.problem, other.fit):
        return found
    if _at_limits(other) - _at_limits(found):
        return found
    return other


def _at_limits(found: Searched) -> set[str]:
    """Effects that have a number at the limit of what is believed."""
    return {e for e in found.fit.active if has_limit(sizes(found.problem, found.fit, e))}


def _coarser(noise: Noise) -> dict[str, float]:
    """Levels of readings that are much finer than a rigid body, as coarse as that."""
    return {
        c: LEAST_READING_STD[c]
        for c, std in noise.reading.items()
        if FINER * std < LEAST_READING_STD[c]
    }


def _flies_better(problem: Problem, fit: Fit, other: Fit) -> bool:
    """Whether the open-loop errors of a fit on the fitted runs are smaller, by their geometric mean."""
    horizon = problem.settings.horizon
    ours, theirs = (
        pooled_rms(replay_runs(problem.engine, f.values, f.noise, horizon)) for f in (fit, other)
    )
    logs = [np.log(ours[c] / theirs[c]) for c in ours if theirs.get(c, 0.0) > 0.0]
    return bool(logs) and float(np.mean(logs)) < 0.0
