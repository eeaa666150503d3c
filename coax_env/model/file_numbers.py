"""What a vehicle file may say of sensors and actuators: names, units, what values must be."""

from collections.abc import Mapping

LONGEST_DELAY = 1.0  # [s]

SENSOR_NUMBERS = {
    "noise": "", "bias": "", "low": "", "high": "", "rate": "Hz", "delay": "s", "dropout": "1",
}  # fmt: skip
"""What a vehicle file may say of a channel, and in which unit; an empty one is the channel's own."""

ACTUATOR_NUMBERS = {
    "swash_travel": "rad",  # each way, per axis
    "swash_rate": "rad/s",
    "rotor_speed_lowest": "rad/s",
    "rotor_speed_highest": "rad/s",
    "rotor_acceleration": "rad/s2",
}
"""Name and unit of the limits a vehicle file may have; all are positive."""


def sensor_number_fault(key: str, value: float) -> str:
    """Why a value cannot stand for one of SENSOR_NUMBERS, in a few words; empty where it can."""
    wanted: Mapping[str, tuple[bool, str]] = {
        "noise": (value >= 0.0, "not be negative"),
        "rate": (value > 0.0, "be positive"),
        "delay": (0.0 <= value <= LONGEST_DELAY, f"be in 0 .. {LONGEST_DELAY:g} s"),
        "dropout": (0.0 <= value < 1.0, "be at least 0 and less than 1"),
    }
    fine, words = wanted.get(key, (True, ""))
    return "" if fine else words
