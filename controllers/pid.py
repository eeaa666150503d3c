"""A cascade of PID loops on the raw sensors, tuned by hand: what most autopilots fly.

::

    position -> speed demand -> speed -> tilt demand -> attitude -> swash
    height -> climb -> both rotors          heading -> turn rate -> one rotor against the other

It knows no model but its trim, which is fed forward: gains tried out on lama400d. Slow and noisy
speeds are smoothed by a first order lag. The position is held only where it is measured (suite
``mocap``).
"""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from coax_env.env import hover
from coax_env.env.actions import Nominal, action_map
from coax_env.env.period import DT
from coax_env.errors import InputError
from coax_env.model import state as S
from coax_env.model.dynamics import hover_trim
from coax_env.model.sensors import suite
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers.feedback import Designed, Feedback
from controllers.target import TargetView, turned

_NEEDED = ("p", "q", "r", "phi", "theta", "psi", "h", "vn", "ve", "vd")
_PLACE = ("pn", "pe")


@dataclass(frozen=True)
class Gains:
    """Of the loops, from outside in, named as in controller.json; an action of 1 is full range."""

    place: float = 0.35  # [m/s per m]
    fastest: float = 0.5  # [m/s], of the speed demand
    speed: float = 0.14  # [rad of tilt per m/s]
    speed_sum: float = 0.02  # [rad per m]
    steepest: float = 0.2  # [rad], of the tilt demand
    tilt: float = 10.0  # [action per rad]
    rate: float = 1.0  # [action per rad/s]
    height: float = 2.5  # [action per m]
    height_sum: float = 0.5  # [action per m s]
    climb: float = 1.0  # [action per m/s]
    heading: float = 5.0  # [action per rad]
    heading_sum: float = 2.0  # [action per rad s]
    turn: float = 1.0  # [action per rad/s]
    smoothing: float = 0.1  # [s] of the speeds


@dataclass
class PID(Feedback, Designed):
    """The cascade for one helicopter or many; ``act`` as every controller."""

    vehicle: str
    sensors: str
    action_trim: np.ndarray  # (4,)
    action_scale: np.ndarray  # (4,)
    gains: Gains = field(default_factory=Gains)
    feedforward: np.ndarray = field(default_factory=lambda: np.zeros(4))  # the trim, as an action

    kind = "pid"

    def __post_init__(self) -> None:
        names = [sensor.name for sensor in suite(self.sensors)]
        missing = [name for name in _NEEDED if name not in names]
        if missing:
            raise InputError(f"pid needs {', '.join(missing)}, which sensors {self.sensors!r} lack")
        self._view = TargetView(self.sensors)
        self._at = {name: names.index(name) for name in (*_NEEDED, *_PLACE) if name in names}

    def begin(self) -> None:
        """New flights of `count` helicopters."""
        self._smooth = np.zeros((self.count, 3))  # forward, right, down [m/s]
        self._sums = np.zeros((self.count, 4))  # forward, right [m], height [m s], heading [rad s]

    def forget(self, which: np.ndarray) -> None:
        """New flights in the rows of a mask (count,)."""
        self._smooth[which], self._sums[which] = 0.0, 0.0

    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to observations (count, n_obs)."""
        batch, there = self._view.as_hover(observations)
        g, y = self.gains, {name: batch[:, at] for name, at in self._at.items()}
        speed = turned(np.column_stack([y["vn"], y["ve"]]), -y["psi"])
        measured = np.column_stack([speed, y["vd"]])
        self._smooth += (measured - self._smooth) * (1.0 - math.exp(-DT / g.smoothing))
        forward, right, down = self._smooth.T
        demand_forward, demand_right = self._speed_demand(y).T
        height = hover.HEIGHT - y["h"]
        heading = -((y["psi"] + math.pi) % (2.0 * math.pi) - math.pi)
        ahead, aside = demand_forward - forward, demand_right - right
        self._sums += DT * there[:, None] * np.column_stack([ahead, aside, height, heading])
        most = np.array([g.steepest / g.speed_sum] * 2 + [0.5 / g.height_sum, 0.5 / g.heading_sum])
        np.clip(self._sums, -most, most, out=self._sums)
        pitch = -(g.speed * ahead + g.speed_sum * self._sums[:, 0])
        roll = g.speed * aside + g.speed_sum * self._sums[:, 1]
        pitch, roll = (np.clip(tilt, -g.steepest, g.steepest) for tilt in (pitch, roll))
        lift = g.height * height + g.height_sum * self._sums[:, 2] + g.climb * down
        turn = g.heading * heading + g.heading_sum * self._sums[:, 3] - g.turn * y["r"]
        return self.feedforward + np.column_stack(
            [
                lift + turn,
                lift - turn,
                g.tilt * (pitch - y["theta"]) - g.rate * y["q"],
                g.tilt * (roll - y["phi"]) - g.rate * y["p"],
            ]
        )

    def _speed_demand(self, y: dict[str, np.ndarray]) -> np.ndarray:
        """Forward and right [m/s] (count, 2), towards a position that is measured."""
        if "pn" not in y:
            return np.zeros((self.count, 2))
        demand = -self.gains.place * np.column_stack([y["pn"], y["pe"]])
        length = np.maximum(np.linalg.norm(demand, axis=1), 1e-9)
        demand *= np.minimum(1.0, self.gains.fastest / length)[:, None]
        return turned(demand, -y["psi"])

    def content(self) -> dict[str, Any]:
        """What a file of this kind has of its own."""
        return {
            "sensors": self.sensors,
            "action_trim": self.action_trim.tolist(),
            "action_scale": self.action_scale.tolist(),
            "gains": asdict(self.gains),
            "feedforward": self.feedforward.tolist(),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "PID":
        """From a JSON file."""
        trim, scale = (
            np.array(content[key], dtype=float) for key in ("action_trim", "action_scale")
        )
        gains = Gains(**content["gains"])
        feedforward = np.array(content.get("feedforward", [0.0] * 4), dtype=float)
        if feedforward.shape != (4,):
            raise ValueError("feedforward must have four numbers")
        return cls(
            str(content["vehicle"]), str(content["sensors"]), trim, scale, gains, feedforward
        )


def design(vehicle: str | Vehicle, nominal: Nominal = None, sensors: str = "onboard") -> PID:
    """The cascade about a vehicle's trim; nothing else of the vehicle is used.

    Args:
        vehicle: whose hover trim, commands and tilt, is fed forward.
        nominal: vehicle whose trim centres the action, as in the env (default: the bare one).
        sensors: suite that it is given; must measure rates, attitude, height and velocity.
    """
    vehicle = load_vehicle(vehicle)
    trim, scale = action_map(vehicle, nominal)
    state, command = hover_trim(vehicle, hover.HEIGHT)
    feedforward = (command - trim) / scale
    # the tilt that it hovers with, which its loops would else take for an error
    feedforward[2:] += Gains().tilt * state[[S.THETA, S.PHI]]
    return PID(vehicle.name, sensors, trim, scale, feedforward=feedforward)
