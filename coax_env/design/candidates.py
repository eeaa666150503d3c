"""Maneuvers that a design chooses from, and the envelope that they must not leave."""

from dataclasses import dataclass

import numpy as np

from coax_env.design.discrimination import ROW
from coax_env.errors import InputError
from coax_env.model.layout import VELOCITY
from coax_env.model.vehicle import Vehicle
from coax_env.simulation.maneuvers import (
    DEGREE,
    Maneuver,
    Steps,
    doublet,
    maneuver,
    pulses,
    steps_3211,
    track,
)
from coax_env.simulation.simulate import Track, fly


@dataclass(frozen=True)
class Envelope:
    """Limits within which a maneuver must stay, whichever description is true.

    Attributes:
        lowest, ceiling: height [m].
        tilt: of roll and pitch [rad].
        turning: yaw rate [rad/s].
        speed: [m/s].
        room: horizontal distance from the start [m].
    """

    lowest: float = 0.15
    ceiling: float = 5.0
    tilt: float = 35.0 * DEGREE
    turning: float = 200.0 * DEGREE
    speed: float = 4.0
    room: float = 15.0

    def breach(self, flown: Track) -> str:
        """What a simulated run leaves the envelope by, in words; empty where it stays inside."""
        height = -flown["z"]
        tilt = np.maximum(abs(flown["phi"]), abs(flown["theta"])).max()
        turning = abs(flown["r"]).max()
        speed = np.linalg.norm(flown.state[:, VELOCITY], axis=1).max()
        away = np.hypot(flown["x"] - flown["x"][0], flown["y"] - flown["y"][0]).max()
        if flown.ended:
            return flown.ended
        if height.min() < self.lowest:
            return f"sinks to {height.min():.2f} m"
        if height.max() > self.ceiling:
            return f"climbs to {height.max():.1f} m"
        if tilt > self.tilt:
            return f"tilts by {tilt / DEGREE:.0f} deg"
        if turning > self.turning:
            return f"turns at {turning / DEGREE:.0f} deg/s"
        if speed > self.speed:
            return f"reaches {speed:.1f} m/s"
        if away > self.room:
            return f"goes {away:.0f} m away"
        return ""


def flown_inside(
    vehicle: Vehicle, plan: Maneuver, envelope: Envelope, with_whom: str = ""
) -> tuple[Track | None, str]:
    """The maneuver flown with a vehicle, or why it must not be.

    Args:
        vehicle: what flies. plan: the maneuver. envelope: that it must not leave.
        with_whom: what the vehicle is, behind the reason for which it leaves it.
    """
    try:
        flown = fly(vehicle, plan, dt=ROW)
    except InputError as error:
        return None, str(error)
    why = envelope.breach(flown)
    return (None, why + with_whom) if why else (flown, "")


def candidates() -> tuple[Maneuver, ...]:
    """The set a design chooses from: about ten seconds each, with a pilot; hover first."""
    return (
        maneuver("hover", duration=10.0),
        *_on_the_swash("lon", "longitudinal", -1.0),
        *_on_the_swash("lat", "lateral", 1.0),
        *(
            _injected("heave_3211", "collective", steps_3211(size, 1.0, unit),
                      f"3-2-1-1 on both rotor speeds, {100 * size:g} %, sides of {unit:g} s")
            for size, unit in ((0.03, 0.7), (0.05, 0.7), (0.08, 0.4))
        ),
        _injected("heave_doublet", "collective", doublet(0.06, 1.0, 0.8),
                  "doublet on both rotor speeds, 6 %, 0.8 s a side"),
        *(
            _injected("yaw_3211", "differential", steps_3211(size, 1.0, unit),
                      f"3-2-1-1 on the difference of the rotor speeds, {100 * size:g} %, "
                      f"sides of {unit:g} s")
            for size, unit in ((0.03, 0.4), (0.05, 0.3))
        ),
        _injected("yaw_doublet", "differential", doublet(0.03, 1.0, 0.8),
                  "doublet on the difference of the rotor speeds, 3 %, 0.8 s a side"),
        *(
            _injected("differential_rpm", "differential", pulses(size, 1.0, 0.25, 1.75, 4),
                      f"short pulses on the difference of the rotor speeds, {100 * size:g} %")
            for size in (0.08, 0.15)
        ),
        _asked("heading_turn", "heading", _turns("0 0, 1 0, 9 4"), "a full turn on the spot"),
        _asked("heading_turn", "heading", _turns("0 0, 1 0, 2.5 1, 4 1, 5.5 2, 7 2, 8.5 3, 10 3"),
               "three quarters of a turn on the spot, a quarter at a time"),
        _asked("low_hover", "height", track("0 1, 1 1, 3 0.4, 5 0.4, 6 0.25, 8 0.25, 10 0.8"),
               "hover while stepping down to a quarter of a metre and up again"),
        _asked("climb_descend", "height", track("0 1.5, 1 1.5, 3 3.5, 4 3.5, 6 1.2, 8 2.8, 10 1.5"),
               "climb and descend at 1 m/s, twice"),
        *(
            _asked(name, axis, track(f"0 0, 1 0, {1 + speed:g} {speed:g}, 6 {speed:g}, 9 0, 10 0"),
                   f"{where} to {speed:g} m/s and stop")
            for name, axis, where in (("forward_run", "forward", "forward"),
                                      ("side_run", "right", "to the right"))
            for speed in (1.5, 3.0)
        ),
    )  # fmt: skip


def _injected(name: str, axis: str, steps: Steps, summary: str) -> Maneuver:
    return Maneuver(name, 10.0, summary, injected={axis: steps})


def _asked(name: str, quantity: str, points: Steps, summary: str) -> Maneuver:
    return Maneuver(name, 10.0, summary, asked={quantity: points}, height=points[0][1] or 1.5)


def _turns(points: str) -> Steps:
    """Points of a heading track given in quarters of a turn."""
    return [(time, quarters * 90.0 * DEGREE) for time, quarters in track(points)]


def _on_the_swash(axis: str, word: str, sign: float) -> list[Maneuver]:
    name = f"delta_{axis}"
    doublets = [
        _injected(f"{axis}_doublet", name, doublet(sign * size * DEGREE, 1.0, side),
                  f"doublet on the {word} swash, {size:g} deg, {side:g} s a side")
        for size, side in ((3.0, 1.0), (5.0, 0.5))
    ]  # fmt: skip
    steps = [
        _injected(f"{axis}_3211", name, steps_3211(sign * size * DEGREE, 1.0, unit),
                  f"3-2-1-1 on the {word} swash, {size:g} deg, sides of {unit:g} s")
        for size, unit in ((4.0, 0.5), (4.0, 0.3), (6.0, 0.3))
    ]  # fmt: skip
    return doublets + steps
