"""The estimation problem of a diagnosis, and a fit to it: both immutable.

The search is a walk over fits. Every move is a function of a problem and a fit that returns another
fit (fits.py, moves.py); what may be free is part of the problem, where the walk stands is the fit.
"""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from coax_env.diagnosis.settings import SETTINGS, Settings
from coax_env.estimation.clock_errors import with_clock_error
from coax_env.estimation.engine import Engine
from coax_env.estimation.fitted_vehicle import median_step
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.helicopter_noise import GUST_LEVELS
from coax_env.estimation.joint_gusts import SHARES
from coax_env.estimation.late_commands import acting_sooner
from coax_env.estimation.low_pass import LowPass, records_before
from coax_env.estimation.parted_engine import AT
from coax_env.estimation.state_space import FreeParameter, Late, Noise, Record
from coax_env.model import effects
from coax_env.model import parameters as P
from coax_env.model.layout import INERTIAL, ROTOR_SPEEDS
from coax_env.progress import Progress

SERVO_FORMS = ("servo_lag", "servo_delay")
"""Two forms of one servo, the usual one first. A real servo is neither: what a critically damped one of
40 ms does to a flight, a delay explains better than a lag by 6 of 110 nats, and by 24 of 320."""

COMMAND_DELAY = "command_delay"

SERVO_RATE = "servo_rate"
"""A limited rate is far from none: from 4 rad/s on no flight shows anything, so that its size is looked
for (moves.py) and not read off a slope. By that one of 0.68 rad/s, worth 1,022 nats, was put at more
than 7 and dropped as too small (**synthetic**)."""

LATE_SERVO = (*SERVO_FORMS, SERVO_RATE)
"""Effects by which the swash plate is late. Beside a lag the little that a limited rate adds says
nothing of what it would explain in its place: each is fitted there. (Of a limit of 1.33 rad/s and a
deadband, play was named and a lag of 91 nats, 17 less likely than the limit: **synthetic**.)"""

LATE_ROTORS = ("motor_lag", "spin_up_reaction")
"""Rotors that follow late, and what the body takes up meanwhile. Where no rotor's speed is read, the
one is not seen without the other: tried one by one they end at nothing, beside half the yaw inertia and
a late command (moves.late_rotors)."""

EXCLUSIVE = (
    frozenset(SERVO_FORMS),
    frozenset({"battery_sag", "battery_voltage"}),
    frozenset({"swash_phase", "frame_yaw"}),
    frozenset({"pose_delay", "attitude_delay"}),
    frozenset({"pose_delay", "command_delay"}),
)
"""Effects of which one at most is named, and the others always tried in its place: a real servo is a
mixture of both; the same rotors slow down; on a log of poses alone the others are one column, and far
from each other."""

WEAK_OR_LATE = frozenset({
    "motor_lag", "motor_droop", "servo_lag", "servo_delay", "servo_play",
    "servo_rate", "swash_gain", "command_delay", "dynamic_inflow", "axial_damping", "yaw_damping",
    "rate_damping", "yaw_inertia",
})  # fmt: skip
"""Effects by which a machine answers its commands weakly or late. So it seems to where whoever flies
answers gusts between the rows of a log, which holds each command until the next, or foresees them
better than the filter does, as by poses alone: of 30 clean **synthetic** flights (`--arms mixed_poses`,
seed 503) three at 60 Hz had a motor lag, yaw damping or yaw inertia of 34 to 60 nats; by telemetry in
gusts of 15 s one had a swash plate that answers 0.87 times, of 17."""

OWN_WEAK_OR_LATE = frozenset({"inertia_xx", "inertia_yy", "inertia_zz", "flap_time_constant"})
"""The vehicle's own numbers by which it does."""

LIKE_DRIFT = frozenset({
    "gyro_bias", "accel_bias", "attitude_bias", "accel_scale", "imu_tilt", "magnetic_field",
})  # fmt: skip
"""Effects of sensors whose errors, were they to last, would look like them."""

PURE_DELAYS = frozenset({"command_delay", "servo_delay"})
"""Of these those that are a constant time."""

OF_ROTORS = frozenset({
    "motor_lag", "motor_droop", "command_delay", "battery_sag", "battery_voltage", "spin_up_reaction",
})  # fmt: skip
"""Effects that part a rotor's speed from its command, and what the body takes up of it at once: without
that a yaw rate denies a motor's lag, and jitter takes its place."""

T = TypeVar("T")


def exclusive_with(effect: str) -> set[str]:
    """The effects that are never named beside this one."""
    return {e for group in EXCLUSIVE if effect in group for e in group} - {effect}


@dataclass(frozen=True)
class Problem:
    """What is fitted to what: the model and records, and every parameter that may be free.

    Attributes:
        model: the helicopter as a state-space model.
        engine: its filter over the records.
        base: the vehicle's own numbers, free whatever effects are active.
        own: candidate effect -> its parameters under their priors.
        added: what is free as the vehicle's own numbers are, from some step on: generic terms
            (unlisted.py) and command gains (input_innovations.py).
        settings: what decides.
        progress: called with a line of text.
        unlike_gusts: whether gusts turned out not to be as the filter has them (evidence.py).
        low_passes: what some channels' readings were taken back through (sensor_low_pass.py).
        of_onboard_filter: whether attitudes are an onboard filter's (onboard_filter.py).
        errors_left: what errors of readings that last are worth beside what was found, where they
            explain too little to be in the model [nats] (sensor_errors.py).
        clock_error: std of the rows' times [s], 0 where they are right (clock_errors.py).
        between_commands: s from one known command to the next, where those between are on straight
            lines (slow_commands.py); 0: every row's is known.
        late_imu: rows by which gyros or accelerometers were moved back (late_imu.py).
        commands_late: s by which commands were taken to act sooner than is written.
    """

    model: HeliModel
    engine: Engine
    base: tuple[FreeParameter, ...]
    own: Mapping[str, tuple[FreeParameter, ...]]
    added: tuple[FreeParameter, ...] = ()
    settings: Settings = SETTINGS
    progress: Progress | None = None
    unlike_gusts: bool = False
    low_passes: Mapping[str, LowPass] = field(default_factory=dict)
    of_onboard_filter: bool = False
    errors_left: float = 0.0
    clock_error: float = 0.0
    between_commands: float = 0.0
    late_imu: Mapping[str, int] = field(default_factory=dict)
    commands_late: float = 0.0

    @classmethod
    def of(
        cls,
        model: HeliModel,
        records: Sequence[Record],
        candidates: Iterable[str] = (),
        settings: Settings = SETTINGS,
        progress: Progress | None = None,
    ) -> "Problem":
        """The problem of naming some of the candidates, the vehicle's own numbers free.

        Args:
            model: the helicopter as a state-space model.
            records: the runs to fit.
            candidates: effects of the catalogue.
            settings: what decides.
            progress: called with a line of text.
        """
        return cls(
            model,
            Engine(model, records),
            tuple(model.base_parameters()),
            {effect: tuple(model.effect_parameters(effect)) for effect in candidates},
            settings=settings,
            progress=progress,
        )

    # --- what may be free ---------------------------------------------------------------------------

    @property
    def candidates(self) -> tuple[str, ...]:
        """Effects that may be named."""
        return tuple(self.own)

    @property
    def parameters(self) -> list[FreeParameter]:
        """Every parameter that may be free, in the order of the quadratic."""
        return [*self.base, *(f for group in self.own.values() for f in group), *self.added]

    def with_free(self, parameters: Iterable[FreeParameter]) -> "Problem":
        """With more parameters that are free whatever effects are active."""
        return replace(self, added=(*self.added, *parameters))

    def with_fixed(self, names: Collection[str]) -> "Problem":
        """Without some of those."""
        return replace(self, added=tuple(f for f in self.added if f.name not in names))

    def of_candidates(self, names: Collection[str]) -> "Problem":
        """With these of the candidates alone."""
        return replace(self, own={e: own for e, own in self.own.items() if e in names})

    def with_model(self, model: HeliModel) -> "Problem":
        """Of another model of the same machine."""
        return replace(
            self, model=model, engine=Engine(model, self.engine.records, self.engine.threads)
        )

    def with_records(self, records: Sequence[Record]) -> "Problem":
        """On other records of the same runs."""
        return replace(self, engine=Engine(self.model, records, self.engine.threads))

    def with_commands_sooner(self, seconds: float) -> "Problem":
        """Whose commands act so much sooner than is written [s]."""
        records = acting_sooner(self.engine.records, seconds)
        return replace(self.with_records(records), commands_late=seconds)

    def behind(self, passes: Mapping[str, LowPass], records: Sequence[Record]) -> "Problem":
        """With readings of some channels as they were before low-passes.

        Args:
            passes: by channel. records: with readings of these as logged.
        """
        before = records_before(records, self.model.channels, passes)
        return replace(self.with_records(before), low_passes={**self.low_passes, **passes})

    @property
    def late(self) -> Late | None:
        """Which readings are moved back where they are late, if any."""
        return self.engine.records[0].late

    @property
    def as_logged(self) -> "Problem":
        """With no readings moved back."""
        return self.with_records([replace(r, late=None) for r in self.engine.records])

    def with_clock_error(self, std: float) -> "Problem":
        """With readings of motion as good as the rows' times are, whose std is this [s]."""
        records = with_clock_error(self.engine.records, std)
        return replace(self.with_records(records), clock_error=std)

    # --- what is free with some effects active --------------------------------------------------------

    def base_names(self, active: Collection[str]) -> list[str]:
        """Parameters that are free whatever is active, but for those that an active effect replaces."""
        replaced = {b for e in active for b in self.file_values(e)}
        return [f.name for f in (*self.base, *self.added) if f.name not in replaced]

    def free_names(self, active: Collection[str]) -> list[str]:
        """Those, and the active effects' own."""
        return self.base_names(active) + [f.name for e in active for f in self.own[e]]

    def free(self, active: Collection[str]) -> list[FreeParameter]:
        """The free parameters themselves."""
        names = set(self.free_names(active))
        return [f for f in self.parameters if f.name in names]

    def free_of_vehicle(self, active: Collection[str]) -> list[FreeParameter]:
        """Those of them that a vehicle file can hold: numbers of the machine as it is at last."""
        of_filter = {*P.COMMAND_GAINS, *SHARES}
        return [f for f in self.free(active) if f.name not in of_filter and AT not in f.name]

    def acting_names(self, effect: str) -> list[str]:
        """An effect's parameters that act as soon as it does (no shapes)."""
        shapes = {p.name for p in effects.CATALOGUE[effect].parameters if p.shape}
        return [f.name for f in self.own[effect] if f.name.split(".")[1] not in shapes]

    def file_values(self, effect: str) -> dict[str, float]:
        """Values that the base parameters replaced by an effect go back to.

        None where it begins in flight: the base parameter is then what was there before.
        """
        if effect in self.model.moments and not self.changes(effect):
            return {}
        return {b: self.model.bare_values[b] for b in effects.CATALOGUE[effect].replaces}

    def changes(self, effect: str) -> bool:
        """Whether an effect has other numbers before its moment (changing_model.py)."""
        return any(AT in f.name for f in self.own.get(effect, ()))

    def off_values(self, effect: str) -> dict[str, float]:
        """Values at which an effect is not there."""
        return {f.name: f.value for f in self.own[effect]}

    @cached_property
    def has_slow_rows(self) -> bool:
        """Whether commands changed unseen between the rows, for all that is known."""
        return self.row > self.settings.slow_rows

    @cached_property
    def reads_seldom(self) -> bool:
        """Whether commands may answer what no reading but a rotor's speed has shown by then."""
        return self.between_readings > self.settings.slow_rows

    @property
    def knows_commands_seldom(self) -> bool:
        """Whether commands may have answered something between those that are known."""
        return self.between_commands > self.settings.slow_rows

    @property
    def smoothed(self) -> bool:
        """Whether readings of gyros or accelerometers were taken back through a low-pass."""
        return not self.low_passes.keys().isdisjoint(INERTIAL)

    @property
    def answers_unseen(self) -> bool:
        """Whether commands may answer what the filter has not seen by then: readings that are seldom,
        commands that are not known between some, gusts that are not as it has them, what is left of a
        sensor's low-pass.
        """
        seldom = self.reads_seldom or self.knows_commands_seldom
        return seldom or self.unlike_gusts or self.smoothed

    def tells_by_spread(self, effect: str) -> bool:
        """Whether answers to what no reading has shown, which are there all the time, are told from an
        effect by when it is worth its nats (where_shown.py).

        What is left of a sensor's low-pass, and commands that are not known between some, make every
        answer late, a large one more. A late command is a late swash plate and late rotors: one of the
        two may show where it should, and such answers be the other. By telemetry a servo's delay was a
        late command so, of 20 nats (**synthetic**).
        """
        return effect != COMMAND_DELAY and not self.smoothed and not self.knows_commands_seldom

    @property
    def unseen_times(self) -> float:
        """Times that what looks like a weak or late answer must be worth more where it is not seen."""
        seldom = self.sees_poses_alone and self.reads_seldom
        return self.settings.seldom_poses_inflation if seldom else self.settings.unseen_inflation

    def times_unseen(self, effect: str) -> float:
        """Times that an effect must be worth more because weak or late answers are not seen."""
        if effect not in WEAK_OR_LATE:
            return 1.0
        slack = self.sees_poses_alone and effect not in PURE_DELAYS
        return self.unseen_times if slack or self.answers_unseen else 1.0

    def is_hidden_by_gains(self, effect: str) -> bool:
        """Whether an effect's slope with the filter's gains held says little of what it is worth.

        A damping changes what a filter makes of gusts; by poses alone a delay of the attitudes does, to
        which the state is drawn: one of 51 ms, 200 nats likelier than a late command and a late servo,
        seemed to gain nothing (**synthetic**).
        """
        late = effect == "attitude_delay" and self.sees_poses_alone
        return late or effects.CATALOGUE[effect].damps

    @cached_property
    def sees_poses_alone(self) -> bool:
        """Whether no gyro or accelerometer was read: who flies may see gusts before poses do."""
        return self.aboard.isdisjoint(INERTIAL)

    @cached_property
    def between_readings(self) -> float:
        """s between rows with a reading that is no rotor's speed, the median; none: endless."""
        moves = [i for i, c in enumerate(self.model.channels) if c not in ROTOR_SPEEDS]
        steps = [np.diff(r.t[np.isfinite(r.z[:, moves]).any(1)]) for r in self.engine.records]
        steps = [own for own in steps if own.size]
        return float(np.median(np.concatenate(steps))) if steps else math.inf

    @cached_property
    def row(self) -> float:
        """s between rows, the median."""
        return median_step(self.engine.records)

    @cached_property
    def aboard(self) -> frozenset[str]:
        """Channels that have a reading."""
        read = np.any([np.isfinite(r.z).any(0) for r in self.engine.records], axis=0)
        return frozenset(np.array(self.model.channels)[read].tolist())

    @property
    def seconds(self) -> float:
        """Flown time that is fitted [s]."""
        return float(sum(r.t[-1] - r.t[0] for r in self.engine.records))

    @property
    def noise_fit_seconds(self) -> float:
        """s of flight on which noise levels are fitted while the search goes on."""
        return max(self.settings.noise_fit_seconds, self.settings.noise_fit_share * self.seconds)

    # --- work -----------------------------------------------------------------------------------------

    def report(self, text: str) -> None:
        """Report progress."""
        if self.progress:
            self.progress(text)

    def for_each(self, work: Callable[[str], T], of: Sequence[str]) -> dict[str, T]:
        """What is found for each effect, several at once, so that no core idles over a last run."""
        with ThreadPoolExecutor(self.engine.threads) as pool:
            return dict(zip(of, pool.map(work, of), strict=True))


@dataclass(frozen=True)
class Fit:
    """A model with some effects active, fitted or on its way there.

    Attributes:
        active: effects in the model, in the order in which they came.
        values: of all parameters.
        noise: levels of process and reading noise.
        objective: minus the log-posterior at its last evaluation [nats].
        levels: the noise levels that are fitted.
        std_ratio: std of a parameter by the likelihood's own curvature (refinement.py), and with how
            far what commands show (evidence.py), or an alternative in another cause's place
            (confounding.py), has it elsewhere, over that by the signatures; 1 where neither is known.
        history: (move, nats) of the search, in order.
        strongest: evidence [nats] and name of the candidate that came nearest to being added, or was;
            the threshold is calibrated on it (scripts/study_diagnosis.py --calibrate).
        denied: effects that left though they were worth a name: where they should show they do not act.
    """

    active: tuple[str, ...]
    values: Mapping[str, float]
    noise: Noise
    objective: float = math.inf
    levels: tuple[str, ...] = GUST_LEVELS
    std_ratio: Mapping[str, float] = field(default_factory=dict)
    history: tuple[tuple[str, float], ...] = ()
    strongest: tuple[float, str] = (-math.inf, "")
    denied: frozenset[str] = frozenset()

    def at(self, values: Mapping[str, float]) -> "Fit":
        """With some values changed."""
        return replace(self, values={**self.values, **values})

    def spread(self, name: str, std: float, inflation: float) -> float:
        """Std of a parameter as it is believed.

        Args:
            name: of the parameter. std: by the signatures.
            inflation: of its variance, by coloured innovations.
        """
        return std * math.sqrt(inflation) * self.std_ratio.get(name, 1.0)

    def noted(self, move: str, nats: float) -> "Fit":
        """With a move in its history."""
        return replace(self, history=(*self.history, (move, nats)))

    def rest(self, effect: str) -> tuple[str, ...]:
        """The active effects but for one."""
        return tuple(e for e in self.active if e != effect)

    def instead(self, old: str, new: str) -> tuple[str, ...]:
        """The active effects with another one in the place of one."""
        return tuple(new if e == old else e for e in self.active)
