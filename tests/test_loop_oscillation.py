"""A control loop that oscillates: what swings with its command at one frequency in all runs."""

import numpy as np
import pytest

from coax_env.design.loop_oscillation import Oscillation, oscillations, remark
from coax_env.logs.flight import Run

DT = 0.01
WAYS = ("gyro", "pose")


def run(
    name: str,
    frequency: float,
    way: str = "gyro",
    amplitude: float = 2.0,
    own: float = 0.0,
    answer: float = 1.0,
) -> Run:
    """14 s of heading: a sine and noise of its own [rad/s], and commands that swing with it."""
    rng = np.random.default_rng(sum(map(ord, name)))
    t = np.arange(0.0, 14.0, DT)
    phase = 2.0 * np.pi * frequency * t
    r = (
        amplitude * np.sin(phase)
        + own * rng.standard_normal(t.size)
        + 0.03 * rng.standard_normal(t.size)
    )
    command = np.tile([200.0, 220.0, 0.0, 0.0], (t.size, 1))
    command[:, 0] -= answer * (10.0 * np.sin(phase - 1.0) + 0.3 * rng.standard_normal(t.size))
    if way == "gyro":
        return Run(name, t, command, {"r": r})
    psi = 3.0 - amplitude / (2.0 * np.pi * frequency) * np.cos(phase)
    psi = (psi + 0.002 * rng.standard_normal(t.size) + np.pi) % (2.0 * np.pi) - np.pi
    psi[1::2] = np.nan
    return Run(name, t, command, {"psi": psi})


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("frequency", [2.3, 6.4])
def test_its_frequency_and_amplitude_are_those_of_the_sine(frequency, way):
    """Through the turn of the heading, of every second row, with a run that does not swing."""
    flight = [run(name, frequency, way) for name in "abcd"] + [
        run("e", frequency, way, 0.0, answer=0.0)
    ]
    (found,) = oscillations(flight)
    assert found.axis == "yaw"
    assert found.frequency == pytest.approx(frequency, abs=0.13), "half of a window's 0.25 Hz"
    assert found.amplitude == pytest.approx(2.0, rel=0.1)
    assert f"{found.frequency:.1f} Hz" in remark([found]) and "lower gains" in remark([found])


@pytest.mark.parametrize(
    "flight",
    [
        [run(name, 6.4) for name in "ab"] + [run(name, 0.0, amplitude=0.0) for name in "cd"],
        [run(name, f) for name, f in zip("abcd", (2.2, 3.0, 4.5, 6.4), strict=True)],
        [run(name, 6.4, answer=0.0) for name in "abcd"],
        [run(name, 6.4, own=5.0) for name in "abcd"],
        [run(name, 1.0) for name in "abcd"],
        [run(name, 30.0) for name in "abcd"],
        [],
    ],
    ids=[
        "half of the runs",
        "each at its own",
        "no command",
        "mostly noise",
        "slow",
        "vibration",
        "none",
    ],
)
def test_what_else_swings_is_no_oscillating_loop(flight):
    assert oscillations(flight) == ()


def test_a_command_that_something_else_moves_at_that_frequency_is_no_answer():
    """Both have a peak there, each with a phase that wanders by itself."""
    rng = np.random.default_rng(4)

    def wandering(name: str) -> Run:
        own = run(name, 3.0)
        t = own.t
        phases = np.cumsum(rng.standard_normal((2, t.size)) * 0.12, axis=1)
        sines = np.sin(2.0 * np.pi * 3.0 * t + phases)
        command = own.command.copy()
        command[:, 0] = 200.0 + 10.0 * sines[0]
        return Run(name, t, command, {"r": 2.0 * sines[1]})

    assert oscillations([wandering(name) for name in "abcd"]) == ()


def test_the_plate_turns_about_two_axes_and_the_widest_swing_comes_first():
    def tilting(name: str) -> Run:
        own = run(name, 6.4)
        command, phase = own.command.copy(), 2.0 * np.pi * 2.5 * own.t
        command[:, 2] = 0.1 * np.sin(phase)  # lon alone: by a plate a quarter turn off it rolls
        return Run(name, own.t, command, {**own.measured, "p": 3.0 * np.sin(phase + 0.4)})

    roll, yaw = oscillations([tilting(name) for name in "abcd"])
    assert (roll.axis, yaw.axis) == ("roll", "yaw") and roll.amplitude > yaw.amplitude
    assert str(Oscillation("roll", 2.5, 3.0)) == (
        "the roll rate swings with its command at 2.5 Hz, by 3 rad/s"
    )
