"""coax_controller.h: what a flight computer gives to an exported controller, and what it gets."""

from coax_env.env import tasks
from coax_env.env.period import DT
from coax_env.model.layout import COMMANDS
from coax_env.model.sensors import Sensor, slow_instruments, suite

MEANINGS = {
    "rpm_upper": "upper rotor's speed, never negative",
    "rpm_lower": "lower rotor's speed, never negative",
    "p": "roll rate, right side down positive",
    "q": "pitch rate, nose up positive",
    "r": "yaw rate, clockwise from above positive",
    "ax": "specific force forward",
    "ay": "specific force to the right",
    "az": "specific force down: -9.8 at hover",
    "phi": "roll, right side down positive",
    "theta": "pitch, nose up positive",
    "psi": "heading, clockwise from north, any turn",
    "h": "height of the centre of gravity above ground, up",
    "vn": "velocity north",
    "ve": "velocity east",
    "vd": "velocity down",
    "pn": "position north of the start",
    "pe": "position east of the start",
    "v": "speed, unsigned",
    "u": "velocity forward, body axes",
    "w": "velocity down, body axes",
    "alpha_l": "lower rotor's flap, positive tilts its thrust back",
    "beta_l": "lower rotor's flap, positive tilts its thrust to the right",
    "alpha_f": "stabiliser bar's tilt, positive tilts the upper thrust back",
    "beta_f": "stabiliser bar's tilt, positive tilts the upper thrust to the right",
    "x": "position north of the start",
    "y": "position east of the start",
    "z": "position down: minus the height",
    "omega_u": "upper rotor's speed, never negative",
    "omega_l": "lower rotor's speed, never negative",
    "swash_lon": "swash plate's tilt, positive tilts the thrust back",
    "swash_lat": "swash plate's tilt, positive tilts the thrust to the right",
}
"""What a positive reading means, by channel or state; ``v`` of the suite `state` is a velocity."""
_STATE_V = "velocity to the right, body axes"
_WAY = {
    "target_forward": "the target's distance ahead, in the horizontal plane",
    "target_right": "and to the right",
    "target_up": "and up",
    "heading_error": "the heading asked for less the measured one, within -pi .. pi",
}
_COMMANDS = {
    "omega_u": "upper rotor's speed",
    "omega_l": "lower rotor's speed",
    "delta_lon": "swash tilt, positive tilts the thrust back",
    "delta_lat": "swash tilt, positive tilts the thrust to the right",
}

HEADER = """\
/* {title}
 *
 * Call coax_reset once before a flight, then coax_step every {period} s, in step with the sensors.
 *
 * AXES     body: x forward, y right, z down; earth: north, east, down. Angles in rad.
 * OLD      A reading slower than {rate:g} Hz keeps its last value until a new one comes. Its
 *          instrument's flag is 1 in the period in which the sample is new and 0 else.{old}
 * NaN      {not_a_number}
 *          An action that is no number becomes 0: the nominal trim.
{cycle} * MEMORY   All of it is in coax_controller; coax_step needs no heap and no more stack than some
 *          {stack} bytes.
 */
#ifndef COAX_CONTROLLER_H
#define COAX_CONTROLLER_H

#ifdef __cplusplus
extern "C" {{
#endif

/* Places in the observation. */
enum {{
{readings}
    COAX_OBSERVED
}};

/* Places in the action and in the command: the command is trim + scale * action, action in [-1, 1]. */
enum {{
{commands}
    COAX_COMMANDS
}};

#define COAX_HAS_TARGET {target}

/* Everything that one controller keeps from period to period; its members are its own affair. */
typedef struct {{
{members}
}} coax_controller;

/* Forget the last flight. */
void coax_reset(coax_controller *controller);

/* One control period.
 *
 * observation: readings and flags.
 * way: {way}
 * action: [1], each within -1 .. 1.
 * command: what the actuators are to do from now on.
 */
void coax_step(coax_controller *controller, const float observation[COAX_OBSERVED],
               const float way[4], float action[COAX_COMMANDS], float command[COAX_COMMANDS]);

#ifdef __cplusplus
}}
#endif

#endif
"""
_CYCLE = """\
 * RATES    The filter's gains follow the sensors' cycle: slow instruments deliver in the periods in
 *          which floor(k rate / {rate:g}) moves on, k counted from coax_reset; all are new at k = 0.
 *          A sample that comes in another period is not used: its gain there is 0.
"""
_WAY_TEXT = """\
NULL: hover at 1.5 m over the start, heading north. Else the way to a target:
{rows}
 *      where one of the four, the position or the heading is no number, the last setpoint holds."""


def header(
    title: str,
    sensors: str,
    members: list[str],
    not_a_number: str,
    stack: int,
    target: bool,
    filtered: bool,
) -> str:
    """The text of coax_controller.h.

    Args:
        title: what it is, in a line.
        sensors: the suite.
        members: of the struct, as C.
        not_a_number: what a reading does that is none.
        stack: bytes, roughly.
        target: whether the sensors show the position that a target needs.
        filtered: whether there is a Kalman filter.
    """
    own = suite(sensors)
    flags = slow_instruments(own)
    names = [_enumerator(s.name, _reading(s, sensors)) for s in own]
    names += [_enumerator(f"{name}_is_new", f"{_rates(own, name)}: 1 where new") for name in flags]
    way = [
        f" *      {k}: {_WAY[name]} [{unit}]" + ("," if k < 3 else ";")
        for k, (name, unit, _) in enumerate(tasks.WAY)
    ]
    return HEADER.format(
        title=title,
        period=f"{DT:g}",
        rate=1.0 / DT,
        old="" if flags else "\n *          (These sensors are all as fast as the loop.)",
        not_a_number=not_a_number,
        cycle=_CYCLE.format(rate=1.0 / DT) if filtered and flags else "",
        stack=stack,
        readings="\n".join(names),
        commands="\n".join(
            _enumerator(f"command_{name}", f"[{unit}] {_COMMANDS[name]}") for name, unit in COMMANDS
        ),
        target=int(target),
        members="\n".join(f"    {member}" for member in members),
        way=_WAY_TEXT.format(rows="\n".join(way)) if target else
        "not used: these sensors show no position. It hovers at 1.5 m, heading north.",
    )  # fmt: skip


def _enumerator(name: str, words: str) -> str:
    return f"    {f'COAX_{name.upper()},':32s} /* {words} */"


def _reading(sensor: Sensor, sensors: str) -> str:
    """Unit, meaning and rate of a reading."""
    own = _STATE_V if (sensors, sensor.name) == ("state", "v") else MEANINGS[sensor.name]
    return f"[{sensor.unit}] {own}; {sensor.instrument}, {sensor.rate:g} Hz"


def _rates(sensors: tuple[Sensor, ...], instrument: str) -> str:
    return f"{next(s.rate for s in sensors if s.instrument == instrument):g} Hz"
