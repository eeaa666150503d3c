"""The running Kalman filter of estimator_design.py: what a controller knows of the helicopter.

Beside the linear model it knows one product: a machine that yaws sees its velocity, tilt and place
turn. It runs for one helicopter or for many at once.
"""

import math
from abc import abstractmethod

import numpy as np

from coax_env.env.hover import DOWN, EAST, HEADING, HORIZONTAL, NORTH
from coax_env.env.period import DT
from coax_env.kernel.angles import wrap_angle, wrap_angles
from coax_env.kernel.compilation import compiled
from coax_env.model.layout import N_COMMANDS
from controllers.estimator_design import (
    GRAVITY,
    EstimatorDesign,
    axis_of,
    horizontal_pairs,
    integrated_readings,
    turned_pairs,
)
from controllers.feedback import Feedback
from controllers.target import Approach, TargetView, turned

WINDUP = 20.0  # integrals stop at so many


class Tracker:
    """The running filter, for one helicopter or many, and the integrals of some readings.

    In every control period: `see` the observation, then report what was done with `acted`. Where the
    observation has a target, all is relative to it (controllers/target.py).
    """

    def __init__(self, design: EstimatorDesign, count: int = 1) -> None:
        self.design = design
        self.count = count
        names = design.readings
        integrated = integrated_readings(design)
        self._integrated = [names.index(name) for name in integrated]
        self._most = WINDUP * np.array(list(integrated.values()))
        self._pairs = horizontal_pairs(design)
        self._view = TargetView(design.sensors)
        self._asked = np.zeros((count, 4))
        self._approach = Approach(count)
        self._axes = [axis_of(name) for name in integrated]
        self._there = np.ones((count, len(integrated)), dtype=np.bool_)
        self._heading = names.index("psi") if "psi" in names else -1
        self._turn = design.index("psi") if "psi" in design.states else -1
        self._turned = turned_pairs(design)
        self._yaw_rate = design.index("r")
        self.offset = design.action_trim - design.command_trim
        self._first = design.first_state
        self._A, self._B, self._C, self._D, self._first_gain, self._gains = (
            np.ascontiguousarray(np.swapaxes(matrix, -1, -2))  # the kernel adds up columns
            for matrix in (
                design.A, design.B, design.C, design.D, design.first_gain[None], design.gains,
            )
        )  # fmt: skip
        self.state = np.zeros((count, len(design.states)))
        self.integrals = np.zeros((count, len(integrated)))
        self._readings = np.zeros((count, len(names)))
        self._command = np.zeros((count, N_COMMANDS))
        self._rows = np.zeros(count, dtype=np.int64)
        self._every = np.ones(count, dtype=np.bool_)
        self.reset(self._every)

    def reset(self, which: np.ndarray) -> None:
        """Forget everything in the rows of a mask: their next observation is a flight's first."""
        self.state[which] = self._first
        self.integrals[which] = 0.0
        self._command[which] = self.offset
        self._rows[which] = 0
        self._approach.reset(which)

    def see(self, observations: np.ndarray, which: np.ndarray | None = None) -> np.ndarray:
        """Take in observations (count, n_obs), only in the rows of a mask where one is given.

        A reading that is no finite number carries no information, and changes nothing.

        Returns:
            what is known, (count, n + i): the estimate and the integrals.
        """
        design = self.design
        which = self._every if which is None else which
        observations = np.asarray(observations)
        motion = self._view.motion(observations)
        if self._view.has_target(observations):
            observations = self._aimed(observations, which)
        _correct(
            which, observations, self._rows,
            self._command, design.reading_places, design.flag_places, self._pairs, self._heading,
            design.reading_trim, self._C, self._D, self._first_gain, self._gains, self.state,
            self._readings,
        )  # fmt: skip
        known = np.hstack([self.state, self.integrals])
        if motion is not None:
            known[:, : len(design.states)] -= self._reference(motion)
        return known

    def _reference(self, motion: np.ndarray) -> np.ndarray:
        """States (count, n) of a machine that moves with the target: its velocity, and the tilt of its
        acceleration (small angles, discs and bar at rest); what is fed back is relative to them.

        Args:
            motion: of the target, tasks.MOTION (count, 7).
        """
        forward, right, up, turn, ahead, aside, _ = motion.T
        found = np.zeros((len(motion), len(self.design.states)))
        wanted = {
            "u": forward, "v": right, "w": -up, "r": turn,
            "theta": -ahead / GRAVITY, "phi": aside / GRAVITY,
        }  # fmt: skip
        for name, value in wanted.items():
            if name in self.design.states:
                found[:, self.design.index(name)] = value
        return found

    def _aimed(self, observations: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Observations from the point asked for; where that has moved, the estimate moves too."""
        reach = self._approach.reach(self._view.way(observations), which, DT * self._rows)
        seen, asked, there = self._view.relative_to_target(observations, reach)
        moved = np.where((self._rows > 0)[:, None], asked - self._asked, 0.0)[which]
        heading = asked[which, HEADING] + seen[which, self._view.names.index("psi")]
        forward, right = turned(moved[:, HORIZONTAL], -heading).T
        changes = {
            "x": forward,
            "y": right,
            "z": moved[:, DOWN],
            "psi": wrap_angles(moved[:, HEADING]),
        }
        for name, change in changes.items():
            if name in self.design.states:
                self.state[which, self.design.index(name)] -= change
        self._asked[which], self._there[which] = asked[which], there[which][:, self._axes]
        return seen

    def acted(self, actions: np.ndarray) -> None:
        """Move on by one control period under actions (count, 4)."""
        if self._view.aims:
            self._approach.acted(actions)
        self._command = self.offset + self.design.action_scale * actions
        _predict(
            self._command, self._A, self._B, self._turn, self._turned, self._yaw_rate, self.state
        )
        self.integrals += DT * self._readings[:, self._integrated] * self._there
        np.clip(self.integrals, -self._most, self._most, out=self.integrals)
        self._rows += 1


class Estimating(Feedback):
    """A controller that sees through the filter: what a Tracker knows is all that it is given."""

    estimator: EstimatorDesign
    tracker: Tracker
    known: np.ndarray  # (count, n + i), the last estimate and integrals, kept to be looked at

    @property
    def sensors(self) -> str:  # type: ignore[override]
        """The suite it must be given."""
        return self.estimator.sensors

    @property
    def nominal(self) -> tuple[np.ndarray, np.ndarray]:
        """Trim and scale of its actions, for ``nominal=`` of the env."""
        return self.estimator.action_trim, self.estimator.action_scale

    def begin(self) -> None:
        """New flights of `count` helicopters."""
        self.tracker = Tracker(self.estimator, self.count)

    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to observations (count, n_obs)."""
        self.known = self.tracker.see(observations)
        return self.actions_from_estimate(self.known)

    @abstractmethod
    def actions_from_estimate(self, known: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to estimates and integrals (count, n + i)."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Observation (n_obs,) or (count, n_obs) to action (4,) or (count, 4), float32."""
        actions = super().act(observation)
        self.tracker.acted(np.atleast_2d(actions))
        return actions


@compiled(fastmath={"contract"})
def _add_product(transposed, vector, total):
    """total += transposed' vector, column by column: fast without another order of the sums."""
    for k in range(len(vector)):
        for j in range(len(total)):
            total[j] += transposed[k, j] * vector[k]


@compiled(makes_arrays=True, fastmath={"contract"})
def _correct(
    which, observations, rows, command, places, flags, pairs, heading,
    trim, C_by_state, D_by_command, first_gain, gains, state, readings,
):  # fmt: skip
    """States after the new readings, and the readings as deviations, horizontal ones turned.

    See EstimatorDesign for `places` to `gains`, matrices transposed; `heading` is the reading of
    it, -1 for none. `state` (count, n) and `readings` (count, m) are changed in place.
    """
    n, m = C_by_state.shape
    expected = np.empty(m)
    for i in range(len(which)):
        if not which[i]:
            continue
        y, x = readings[i], state[i]
        for k in range(m):
            y[k] = observations[i, places[k]]
        expected[:] = 0.0
        _add_product(C_by_state, x, expected)
        _add_product(D_by_command, command[i], expected)
        if heading >= 0:
            if not math.isfinite(y[heading]):
                y[heading] = expected[heading] + trim[heading]
            cosine, sine = math.cos(y[heading]), math.sin(y[heading])
            for j in range(len(pairs)):
                a, b = pairs[j, NORTH], pairs[j, EAST]
                north, east = y[a], y[b]
                y[a] = cosine * north + sine * east
                y[b] = cosine * east - sine * north
        gain = first_gain[0] if rows[i] == 0 else gains[rows[i] % len(gains)]
        for k in range(m):
            y[k] -= trim[k]
            if not math.isfinite(y[k]):  # no number, no information
                y[k] = expected[k]
                continue
            if k == heading:
                y[k] = wrap_angle(y[k])
            if flags[k] >= 0 and observations[i, flags[k]] <= 0.5:
                continue
            innovation = y[k] - expected[k]
            if k == heading:
                innovation = wrap_angle(innovation)
            for j in range(n):
                x[j] += gain[k, j] * innovation


@compiled(makes_arrays=True, fastmath={"contract"})
def _predict(command, A_by_state, B_by_command, turn, pairs, yaw_rate, state):
    """Move states (count, n) on by one control period, in place: x = A x + B du, `pairs` (k, 2) then
    turned by what state number `yaw_rate` turns the axes in it.

    The heading, state number `turn` (-1: none), stays within -pi .. pi: whatever a compass has made
    of it, no controller is to fly a whole turn back.
    """
    before = np.empty(state.shape[1])
    for i in range(len(state)):
        for j in range(len(before)):
            before[j] = state[i, j]
        state[i] = 0.0
        _add_product(A_by_state, before, state[i])
        _add_product(B_by_command, command[i], state[i])
        cosine, sine = math.cos(DT * before[yaw_rate]), math.sin(DT * before[yaw_rate])
        for k in range(len(pairs)):
            a, b = pairs[k, 0], pairs[k, 1]
            first, second = state[i, a], state[i, b]
            state[i, a] = cosine * first + sine * second
            state[i, b] = cosine * second - sine * first
        if turn >= 0:
            state[i, turn] = wrap_angle(state[i, turn])
