"""Searches that begin with what moves the rotors.

Where measured rotor speeds stay coloured, the search is done again with rotors that jitter in the
filter (estimation/rotor_jitter.py), if these are worth more than a tie: after a motor's lag, which
colours them too and must be found as what it is. So it is where a lag is found that the answers to
commands do not show: jitter makes one. Where speeds come late themselves (late_rotor_speeds.py) it is
done with those before their low-pass, or without them. Jitter that no rotor speed shows is asked for
where the yaw rate is coloured, by poses alone where anything is named.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from coax_env.diagnosis.fits import fitted, in_noise_from, is_much_coloured, noise_fitted
from coax_env.diagnosis.late_rotor_speeds import (
    LAG,
    behind_low_pass,
    come_late,
    with_less_lag,
    without_speeds,
)
from coax_env.diagnosis.problem import OF_ROTORS, Fit, Problem
from coax_env.diagnosis.rotor_jitter import in_jitter
from coax_env.diagnosis.search import added
from coax_env.diagnosis.searches.once import (
    Searched,
    as_given,
    is_coloured,
    nothing_forgotten,
    searched_from,
    searched_once,
)
from coax_env.estimation.helicopter_noise import (
    JITTER_LEVEL,
    JITTER_MEMORY,
    JITTER_REACTION,
    JITTER_RETURN,
)
from coax_env.estimation.rotor_jitter import with_jitter
from coax_env.estimation.state_space import Noise
from coax_env.estimation.whiteness import correlation
from coax_env.model.layout import ROTOR_SPEEDS, RPM_PER_RAD_S

JITTER = (JITTER_LEVEL, JITTER_MEMORY, JITTER_REACTION, JITTER_RETURN)
"""What is found of jitter before the search in it, and kept."""
STRAYING = 5.0
"""std by which neighbouring differences of rotor speeds from their commands must be alike; ours."""
SHOWN_BY = (*ROTOR_SPEEDS, "r")
"""Channels that a rotor's jitter colours."""
SHOWN_WITHIN, SHOWN_FROM, LEAST_APART = 3.0, 4.0, 0.1
"""A lag's answers to commands are shown within so many std of all of them and so many from none; a
tenth more or less is another form. 1.00 +- 0.01 of true lags, 0.45 +- 0.03 of jitter taken for one;
ours."""


def rotors_first(problem: Problem, noise: Noise) -> tuple[Searched, Noise] | None:
    """The search that begins with what moves the rotors, and levels it started from; None where
    measured rotor speeds show nothing that does.

    Jitter that these show plainly is in it at once: asked after a whole search, it costs another one.

    Args:
        problem: what may be free. noise: levels to start from.
    """
    if not _rotors_stray(problem):
        return None
    bare, refitted = as_given(problem, noise)
    problem.report("searching for causes")
    rotors, quadratic = added(problem.of_candidates(OF_ROTORS), refitted)
    found = Searched(problem, bare, refitted, rotors, quadratic)
    if is_coloured(found, ROTOR_SPEEDS):
        rotors = _in_noise_anew(problem, rotors, noise)
        found = replace(found, fit=rotors)
    coloured = is_coloured(found, ROTOR_SPEEDS)
    late = with_late_speeds(problem, problem, rotors, noise) if coloured else None
    if late is not None:
        return late, noise
    jitter = in_jitter(problem, rotors, quadratic) if coloured else None
    if jitter is None or rotors.objective - jitter[1].objective < problem.settings.clear:
        return searched_from(problem, bare, refitted, rotors), noise
    wider, fit = jitter
    begun = _with_levels_of_jitter(noise, wider, fit)
    problem.report("searching with rotor speeds that jitter")
    return nothing_forgotten(searched_once(wider, begun), fit), begun


def with_late_speeds(
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
        return searched_once(behind, noise)
    if not come_late(others, coloured):
        return None
    problem.report("searching without the measured rotor speeds, which come late")
    found = searched_once(without_speeds(problem), noise)
    own = {f.name: fit.values[f.name] for f in problem.own[LAG]}
    begun = replace(fit.at(found.fit.values).at(own), active=(*found.fit.rest(LAG), LAG))
    again = fitted(beside, begun)
    others = with_less_lag(beside, again)
    return found if others is not None and come_late(others, coloured) else None


def jittery_if_asked(found: Searched, noise: Noise) -> tuple[Searched, Noise]:
    """As `jittery`, where what is coloured or named asks for it."""
    asks = is_coloured(found, SHOWN_BY) or _may_hide_jitter(found)
    return jittery(found, noise) if asks else (found, noise)


def jittery(found: Searched, noise: Noise) -> tuple[Searched, Noise]:
    """The search with rotors that jitter, where that ends likelier, and levels it started from.

    Where no rotor speed is read and much is coloured in jitter, too, the model lacks something else: of
    the second real helicopter 55 % of the error was removed then, not 72.

    Args:
        found: with such rotors already, or without. noise: levels that it started from.
    """
    jitter = in_jitter(found.problem, found.fit, found.quadratic)
    if jitter is None:
        return found, noise
    wider, fit = jitter
    if found.problem.aboard.isdisjoint(ROTOR_SPEEDS) and is_much_coloured(wider, fit):
        return found, noise
    wider.report("searching again with rotor speeds that jitter")
    begun = _with_levels_of_jitter(noise, wider, fit)
    other = nothing_forgotten(searched_once(wider, begun), fit)
    gained = found.cost - other.cost
    wider.report(f"rotor speeds that jitter after the search: {gained:.1f} nats")
    return (other, begun) if gained > 0.0 else (found, noise)


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


def is_lag_unshown(found: Searched) -> bool:
    """Whether a motor's lag was found that measured rotor speeds do not show as answers to commands.

    A lag gives shaken rotors a memory, as jitter does, and both leave speeds white. In a hover and a
    turn, where jitter shook them more than commands, two clean **synthetic** flights of 28 s had a lag
    of 25 ms and a spin-up reaction of 0.43, sure; with jitter they are 680 and 750 nats likelier
    without either.
    """
    problem, fit = found.problem, found.fit
    if LAG not in fit.active or problem.aboard.isdisjoint(ROTOR_SPEEDS):
        return False
    share, std = _share_of_lag(problem, [fit.values[f.name] for f in problem.own[LAG]])
    apart = abs(share - 1.0) > max(SHOWN_WITHIN * std, LEAST_APART)
    return apart or share < SHOWN_FROM * std


def _share_of_lag(problem: Problem, lags: Sequence[float]) -> tuple[float, float]:
    """Share of a lag's answers to commands that measured speeds show, and its std; 0 and inf of none.

    Speeds less their commands, regressed on what the lag makes of these; both less what is left of the
    row before, as a shaken rotor with that lag has it, so that errors are white.

    Args:
        problem: whose records are asked. lags: of the rotors [s].
    """
    products = np.zeros(3)  # of answers with themselves and with speeds, of speeds with themselves
    rows = 0
    for k, (channel, lag) in enumerate(zip(ROTOR_SPEEDS, lags, strict=True)):
        if lag < problem.row:
            continue  # too short to be told from none
        stays = math.exp(-problem.row / lag)
        for record in problem.engine.records:
            command = record.command[:, k]
            late = lfilter([0.0, 1.0 - stays], [1.0, -stays], command - command[0])
            speed = record.z[:, problem.model.channels.index(channel)] / RPM_PER_RAD_S
            both = np.stack([late + command[0] - command, speed - command])
            both = both[:, 1:] - stays * both[:, :-1]
            both = both[:, np.isfinite(both[1])]
            if both.size:
                both = both - both.mean(axis=1, keepdims=True)
                products += both[0] @ both[0], both[0] @ both[1], both[1] @ both[1]
                rows += both.shape[1]
    answers, common, speeds = products.tolist()
    if answers == 0.0:
        return 0.0, math.inf
    share = common / answers
    return share, math.sqrt(max(speeds - share * common, 0.0) / (rows * answers))


def _may_hide_jitter(found: Searched) -> bool:
    """Whether something is named where no reading would be coloured by rotors that jitter.

    Where what is read is much coloured all the same, the model lacks something else, which jitter would
    take up: of the first real helicopter 32 % of the error was removed then, not 51.
    """
    problem = found.problem
    unseen = problem.sees_poses_alone and problem.aboard.isdisjoint(ROTOR_SPEEDS)
    return unseen and bool(found.fit.active) and not is_much_coloured(problem, found.fit)


def _with_levels_of_jitter(noise: Noise, wider: Problem, fit: Fit) -> Noise:
    """Levels to start from, with those of jitter as they were found."""
    of_jitter = {name: fit.noise.level(name) for name in JITTER}
    return with_jitter(noise, wider.model).with_levels(of_jitter)
