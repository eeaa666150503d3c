"""Sensors: which channels are measured, how well, how often, and within which bounds.

One table of suites serves the env, simulated flight folders and the controllers' estimator. True
readings come from `dynamics.measure`, eq. (45), sensor effects included; sampling.py gives them delay,
noise, bias, a rate, limits and lost samples. Sources of the numbers: Table V (noise), Table VI
(ranges), the rest ours. A vehicle file may have its own numbers for a channel
(file_numbers.py); they take the place of the suites', in all suites but ``state``, which is exact.

A channel slower than the 100 Hz of the control loop holds its last value, and its instrument has a
flag in the observation that says whether it is new in this row. Which instruments have a flag is the
suite's alone: observations have one layout whatever flies.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

from coax_env.errors import InputError
from coax_env.model.layout import ACTUATOR_STATES, CHANNEL_UNITS, CHANNELS, N_CHANNELS, STATES
from coax_env.model.vehicle import Vehicle

BASE_RATE = 100.0  # [Hz] of the control loop and of the paper's log

_DEGREE = math.pi / 180.0
_FREE_FALLS = 6.0 * 9.80665  # Table VI: accelerometers of 6 g


@dataclass(frozen=True)
class Sensor:
    """One measured quantity.

    ``name`` is a channel of layout.CHANNELS or, in the suite ``state``, a state's; ``noise`` the
    std of white noise, ``low`` and ``high`` the bounds, all in ``unit``; ``rate`` in Hz; ``index``
    its place in the row of readings followed by the full state, from which the env picks.

    ``bias`` is added to every reading, and ``bias_std`` is the std of a further one that each flight
    draws; readings show what was ``delay`` seconds ago; of the samples due, the share ``dropout`` is
    lost, for the channels of one instrument together. ``flagged``: see `slow_instruments`.
    """

    name: str
    instrument: str
    noise: float
    rate: float
    low: float
    high: float
    unit: str
    index: int
    flagged: bool = False
    bias: float = 0.0
    bias_std: float = 0.0
    delay: float = 0.0
    dropout: float = 0.0

    @property
    def wraps(self) -> bool:
        """Whether the reading is an angle that runs round: -pi is pi."""
        return self.name == "psi"


def _sensors(
    instrument: str, names: str, noise: float, rate: float, low: float, high: float
) -> tuple[Sensor, ...]:
    return tuple(
        Sensor(
            n, instrument, noise, rate, low, high, CHANNEL_UNITS[n], CHANNELS.index(n),
            flagged=rate < BASE_RATE,
        )
        for n in names.split()
    )  # fmt: skip


_GYROS = _sensors("gyros", "p q r", 2.0 * _DEGREE, 100.0, -500.0 * _DEGREE, 500.0 * _DEGREE)
_ACCELEROMETERS = _sensors("accelerometers", "ax ay az", 0.1, 100.0, -_FREE_FALLS, _FREE_FALLS)
_COMPASS = (
    *_sensors("compass", "phi", 0.5 * _DEGREE, 40.0, -math.pi, math.pi),
    *_sensors("compass", "theta", 0.5 * _DEGREE, 40.0, -math.pi / 2, math.pi / 2),
    *_sensors("compass", "psi", 0.5 * _DEGREE, 40.0, -math.pi, math.pi),
)
_ENCODERS = _sensors("encoders", "rpm_upper rpm_lower", 2.0, 100.0, 0.0, 4000.0)
_ONBOARD = (
    *_ENCODERS,
    *_GYROS,
    *_ACCELEROMETERS,
    *_COMPASS,
    *_sensors("sonar", "h", 0.05, 20.0, 0.15, 6.5),
    *_sensors("velocity", "vn ve vd", 0.2, 10.0, -30.0, 30.0),
)
_STATE_LIMITS = {
    "m/s": 60.0, "rad/s": 60.0, "rad": math.pi, "m": 100.0,
    "omega_u": 1000.0, "omega_l": 1000.0,
}  # fmt: skip

SUITES: dict[str, tuple[Sensor, ...]] = {
    "onboard": _ONBOARD,
    "paper": (
        *_GYROS,
        *_ACCELEROMETERS,
        *_sensors("sonar", "h", 0.05, 100.0, 0.15, 6.5),
        *_sensors("speed", "v", 0.5, 100.0, 0.0, 30.0),
    ),
    "mocap": (*_ONBOARD, *_sensors("mocap", "pn pe", 0.002, 100.0, -100.0, 100.0)),
    "state": tuple(
        Sensor(name, "truth", 0.0, 100.0, -limit, limit, unit, N_CHANNELS + i)
        for i, (name, unit) in enumerate((*STATES, *ACTUATOR_STATES))
        for limit in (_STATE_LIMITS.get(name, _STATE_LIMITS[unit]),)
    ),
}
"""Suite -> its sensors, in the order of the observation.

``onboard`` is a small machine's own; ``paper`` is eq. (45) with Table V, every channel at 100 Hz;
``mocap`` is ``onboard`` with horizontal position; ``state`` is the sixteen states, rotor speeds and
swash tilt, exact.
"""

EXACT_LOG = tuple(
    Sensor(name, "truth", 0.0, 100.0, -math.inf, math.inf, unit, i)
    for i, (name, unit) in enumerate(CHANNEL_UNITS.items())
)
"""Every canonical channel without noise: what ``state`` means for a flight folder."""


def suite(name: str, vehicle: Vehicle | None = None) -> tuple[Sensor, ...]:
    """The sensors of a suite by name, with the numbers that a vehicle's file has of its own."""
    if name not in SUITES:
        raise InputError(f"no sensor suite {name!r}: choose one of {', '.join(SUITES)}")
    if vehicle is None or name == "state":
        return SUITES[name]
    return tuple(_as_in_file(sensor, vehicle) for sensor in SUITES[name])


def _as_in_file(sensor: Sensor, vehicle: Vehicle) -> Sensor:
    table = vehicle.sensors.get(sensor.name, {})
    numbers: dict[str, Any] = {key: parameter.value for key, parameter in table.items()}
    if "bias" in table:
        numbers["bias_std"] = table["bias"].std
    sensor = replace(sensor, **numbers)
    if sensor.low >= sensor.high:
        raise InputError(
            f"vehicle {vehicle.name!r}: sensors.{sensor.name}: low {sensor.low:g} is not below "
            f"high {sensor.high:g}"
        )
    return sensor


def log_suite(name: str, vehicle: Vehicle | None = None) -> tuple[Sensor, ...]:
    """The suite as a flight folder can hold it: canonical channels only."""
    return EXACT_LOG if name == "state" else suite(name, vehicle)


def slow_instruments(sensors: tuple[Sensor, ...]) -> tuple[str, ...]:
    """Instruments that their suite has slower than the control loop, in order: those with a flag."""
    return tuple(dict.fromkeys(s.instrument for s in sensors if s.flagged))
