"""When may a name be believed? Each cause is sure, or doubtful with the reasons in plain words.

Sure is what holds: under half and twice every noise level (noise_variation.py), without any one run and
on halves of the flights (replication.py), with white innovations where it shows and no generic term
(unlisted.py), a usual size and no cause at its limit beside it, a number that the flights determine, no
other effect that would do as well, and more evidence than something that no list has, or a single gust
(shocks.py), gives a wrong name. A doubtful cause still improves the model, and stays in it. Where more
speaks against it (doubts.py) it has no name: the model keeps it, findings tell it among what is
unexplained.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from coax_env.diagnosis.confounding import (
    KNOWN,
    channels_of,
    channels_of_numbers,
    untold,
)
from coax_env.diagnosis.doubts import LOUD, Against, doubts, on_parts, sizes, weak, without_name
from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.late_rotor_speeds import LAG, by_speeds_alone
from coax_env.diagnosis.noise_variation import not_holding
from coax_env.diagnosis.onboard_filter import CIRCULAR
from coax_env.diagnosis.problem import LIKE_DRIFT, Fit, Problem
from coax_env.diagnosis.replication import Asked, Replication, halves_of, of_runs, replications
from coax_env.diagnosis.sensor_low_pass import may_hide_behind
from coax_env.diagnosis.settings import SETTINGS, Settings
from coax_env.diagnosis.shocks import in_shocks
from coax_env.diagnosis.unlisted import acted_on
from coax_env.diagnosis.unseen import Unseen
from coax_env.diagnosis.weighing import Weighed
from coax_env.diagnosis.where_shown import SizeWhereMost, size_where_most
from coax_env.estimation.battery import PER_VOLT, FeltVoltage
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.vibration import Line

MOVED = 3.0
"""Prior std by which a number of the vehicle has gone too far for what shows in its channels to be
sure: either the file is wrong, or what is named beside it. A yaw inertia 3.2 std too large stood beside
a spin-up reaction of 1.8 +- 0.15, where 1 is true (`tests/blade_element.py`, **synthetic**); ours."""

TAKEN_BACK = 0.1
"""Share of an accelerometer's bias that a tilt beside it must leave at rest, or they are one thing with
two names: by chance a pair in a hundred does. Gyros alone that were turned by 1.1 degrees were both,
sure, for 640 and 595 nats (**synthetic**; an inertial sensor's axes are square to 1 or 2 %); ours."""


BETWEEN_RUNS = (
    "the voltage differs from run to run, and in none by enough to show it: another load on these runs"
    " would look the same"
)


@dataclass(frozen=True)
class Trust:
    """What is known of a name.

    Attributes:
        noise: it holds at half and twice every noise level.
        runs: share of left-out runs without which it returns.
        kept: share of halves in which it returns; None where none could tell.
        determined: parameter -> whether the flights say more of it than its prior did.
        doubts: reasons against the name, in plain words; none: it is sure.
        channels: in which it shows most, strongest first.
        named: whether it is stated as a cause; what is not is told among the unexplained.
        unseen: what it is worth on the held-out runs; None where none were asked.
        where_most: its size where the flights show half of it; None where that is not known.
    """

    noise: bool
    runs: float
    kept: float | None
    determined: Mapping[str, bool]
    doubts: tuple[str, ...]
    channels: tuple[str, ...]
    named: bool = True
    unseen: Unseen | None = None
    where_most: SizeWhereMost | None = None

    @property
    def word(self) -> str:
        """findings.json's `trust`."""
        return "doubtful" if self.doubts else "sure"

    def entries(self) -> dict[str, Any]:
        """What findings.json has of it, beside `determined`."""
        return {
            "robust": {"noise": self.noise, "runs": self.runs, "kept": self.kept},
            "trust": self.word,
            "doubts": list(self.doubts),
            "since": None,
            "unseen": self.unseen and self.unseen.entry(),
            "where_most": self.where_most and self.where_most.entry(),
        }


def trusts(
    weighed: Weighed, unseen: Mapping[str, Unseen], worse: bool, oscillates: bool
) -> dict[str, Trust]:
    """Every active effect judged.

    Args:
        weighed: the causes.
        unseen: worth of each on the held-out runs, where that was asked.
        worse: whether the model with the causes flies these worse.
        oscillates: whether the control loop oscillates through the flight.
    """
    problem, fit, quadratic, evidence, _, found = weighed.settled
    white, onsets, flown = weighed.white, weighed.onsets, weighed.flown
    worth = {effect: judged.nats for effect, judged in evidence.items()}
    replicated = replications(problem, fit, quadratic, worth)
    falling = not_holding(problem, fit, quadratic, worth)
    shaken = bool(fit.active) and in_shocks(problem, fit)
    runs = len(of_runs(problem.engine.records))
    loud = tuple(channel for channel, of in white.items() if of.spread > LOUD)
    elsewhere = sum(not of.white for of in white.values()) / max(len(white), 1)
    acting = acted_on(problem)
    of_form = problem.settings.oscillating_form * sum(worth.values()) if oscillates else 0.0
    far = moved_far(problem, flown, quadratic)
    undone = taken_back(flown)
    unconfirmed = by_speeds_alone(problem, fit)
    known, against = {}, {}
    for effect in fit.active:
        channels = channels_of(problem, fit, quadratic, effect)
        known[effect] = determined(problem, fit, quadratic, effect, evidence[effect].inflation)
        against[effect] = Against(
            channels=tuple(channels),
            coloured=tuple(c for c in channels if c in white and not white[c].white),
            elsewhere=elsewhere,
            likelier_without=evidence[effect].against,
            loud=loud,
            falls_at=tuple(falling[effect]),
            parts=replicated[effect],
            runs=runs,
            sizes=sizes(problem, flown, effect),
            determined=any(known[effect][name] for name in problem.acting_names(effect)),
            may_be_none=may_be_none(problem, fit, quadratic, effect, evidence[effect].inflation),
            flies_worse=worse,
            unseen=unseen.get(effect),
            within_form=worth[effect] < of_form,
            alternatives=tuple(
                dict.fromkeys((*found[effect], *untold(problem, fit, quadratic, effect)))
            ),
            nats=worth[effect],
            of_moment=onsets[effect].beside if effect in onsets else math.inf,
            shaken=shaken,
            poses_alone=problem.sees_poses_alone,
            clock_error=problem.clock_error,
            smoothed=may_hide_behind(problem, fit, effect),
            errors_left=problem.errors_left if effect in LIKE_DRIFT else 0.0,
            beside_terms=tuple(c for c in channels if c in acting),
            beside_moved=tuple(name for name, own in far.items() if own & set(channels)),
            taken_back_by=undone.get(effect, ""),
            by_speeds_alone=effect == LAG and unconfirmed,
            followed=problem.of_onboard_filter and effect in CIRCULAR,
            where_most=where_most(problem, fit, evidence[effect]),
        )
    nameless = without_name(against, problem.settings)
    return {
        effect: Trust(
            not of.falls_at, of.parts.runs, of.parts.kept, known[effect],
            tuple(doubts(effect, against, problem.settings)), of.channels, effect not in nameless,
            of.unseen, of.where_most,
        )
        for effect, of in against.items()
    }  # fmt: skip


def where_most(problem: Problem, fit: Fit, weighed: Evidence) -> SizeWhereMost | None:
    """A cause's size where the flights show most of it, if it was weighed.

    Args:
        problem, fit: with the cause. weighed: what it is worth, with the fit without it.
    """
    if weighed.rest is None:
        return None
    return size_where_most(problem, fit, weighed.rest, weighed.colour)


def taken_back(fit: Fit) -> dict[str, str]:
    """An IMU's tilt and an accelerometer's bias that do nothing together at rest; none: empty.

    Turned by (x, y), accelerometers that feel -g along z read g y forwards and -g x to the right.

    Args:
        fit: with the causes.
    """
    tilt, bias = "imu_tilt", "accel_bias"
    if not {tilt, bias} <= set(fit.active):
        return {}
    g, of = fit.values["gravity"], fit.values
    forwards, right = of[f"{bias}.x"], of[f"{bias}.y"]
    left = math.hypot(forwards + g * of[f"{tilt}.y"], right - g * of[f"{tilt}.x"])
    alike = left < TAKEN_BACK * math.hypot(forwards, right)
    return {tilt: bias, bias: tilt} if alike else {}


def moved_far(problem: Problem, fit: Fit, quadratic: Quadratic) -> dict[str, set[str]]:
    """The vehicle's own numbers that are more than MOVED prior std from its file's, and the channels in
    which that shows.

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit.
    """
    free = set(problem.base_names(fit.active))
    return {
        f.name: set(channels_of_numbers(fit, quadratic, [f]))
        for f in problem.base
        if f.name in free and abs(fit.values[f.name] - f.value) > MOVED * f.std
    }


def may_be_none(
    problem: Problem, fit: Fit, quadratic: Quadratic, effect: str, inflation: float
) -> bool:
    """Whether nothing is within KNOWN std of each of an effect's numbers.

    By poses alone a `swash_gain` of -0.63 +- 0.50 was worth 58 nats and is not there
    (`tests/blade_element.py`, **synthetic**).

    Args:
        problem, fit: with the effect. quadratic: linearised at the fit.
        effect: an active one. inflation: of its variance, by coloured innovations.
    """
    std = quadratic.std(problem.free_names(fit.active))
    acting = set(problem.acting_names(effect))
    return all(
        abs(fit.values[f.name] - f.value) < KNOWN * fit.spread(f.name, std[f.name], inflation)
        for f in problem.own[effect]
        if f.name in acting
    )


def of_line(line: Line, chosen: Settings = SETTINGS) -> Trust:
    """What is known of a vibration, which is found by its line and not by a signature.

    Its evidence compares the line with its neighbours, so that no level of noise is in it.

    Args:
        line: with its segments.
        chosen: what decides.
    """
    runs = [name for name, ratios in line.ratios.items() if ratios]
    rest = [[r for n in runs if n != out for r in line.ratios[n]] for out in runs]
    every = [r for n in runs for r in line.ratios[n]]
    groups = [range(len(every))]
    halves = [[every[i] for i in half] for half in halves_of(groups, chosen.splits)]

    def returns(part: Sequence[float]) -> bool:
        asked = Asked(len(part) / len(every), 1.0, line.evidence, chosen)
        return asked.can_tell and asked.margin(line.evidence_of(part)) >= 0.0

    of_parts = Replication.of(runs, list(map(returns, rest)), map(returns, halves))
    against = tuple(on_parts(of_parts, len(runs), chosen))
    known = {f"vibration.{line.kind}": True}
    return Trust(True, of_parts.runs, of_parts.kept, known, against, line.channels)


def of_voltage(felt: FeltVoltage, chosen: Settings = SETTINGS) -> Trust:
    """What is known of speeds that follow the battery's voltage, as the felt thrust shows it.

    Args:
        felt: with a line. chosen: what decides.
    """
    assert felt.line is not None
    whole, runs = felt.line, tuple(felt.points)

    def returns(part: FeltVoltage) -> bool | None:
        line = part.line
        share = min((whole.std / line.std) ** 2, 1.0) if line else 0.0
        asked = Asked(share, 1.0, whole.evidence, chosen)
        return asked.margin(part.evidence) >= 0.0 if asked.can_tell else None

    without = [returns(felt.of(n for n in runs if n != out)) for out in runs]
    halves = halves_of([range(len(runs))], chosen.splits)
    halved = [returns(felt.of(runs[i] for i in half)) for half in halves]
    of_parts = Replication.of(runs, without, halved)
    against = [*on_parts(of_parts, len(runs), chosen), *weak(whole.evidence, False, chosen)]
    if felt.within_runs.evidence < chosen.evidence:
        against.append(BETWEEN_RUNS)
    known = {PER_VOLT: True}
    return Trust(True, of_parts.runs, of_parts.kept, known, tuple(against), ("az", "h"))


def determined(
    problem: Problem, fit: Fit, quadratic: Quadratic, effect: str, inflation: float
) -> dict[str, bool]:
    """Whether the flights determine each of an effect's parameters, or its interval is the prior's.

    Args:
        problem, fit: with the effect.
        quadratic: linearised at the fit.
        effect: an active one.
        inflation: of the data's variance, by coloured innovations.
    """
    free = problem.free_names(fit.active)
    variance = dict(zip(free, quadratic.covariance(free).diagonal(), strict=True))
    result = {}
    for f in problem.own[effect]:
        of_data = max(1.0 / variance[f.name] - 1.0 / f.std**2, 0.0) / inflation
        left = 1.0 / math.sqrt(1.0 + of_data * f.std**2)  # std over the prior's
        result[f.name] = left <= problem.settings.undetermined
    return result
