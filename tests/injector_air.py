"""The injector's air: what pushes the vehicle beside its commands, as time histories.

A history is (steps, DISTURBANCES): 0-2 force and 3-5 moment in body axes [N, N m]; 6 share by which
thrust, 7 share by which the upper rotor's torque is more than it should be; 8-9 rotor speeds above
what they would be [rad/s]; 10-12 force in axes north, east, down [N].
"""

import math
from typing import NamedTuple

import numpy as np
from injector_craft import LAMA, Craft, rotors_of
from scipy.signal import lfilter

DISTURBANCES = 13
FEET = 1.0 / 0.3048


class Air(NamedTuple):
    """What the air and the machine's own unrest do; nothing by default.

    gusts: "none", "markov" (exponential memory), "heavy_tails" (the same, shaken by Student's t with
        three degrees of freedom), "one_minus_cosine" (single gusts), "dryden", "shedding" (each axis
        with a frequency), "broad" (memories of 0.05, 0.4 and 3 s at once), "fitful" (weak and strong),
        "one_sided" (skewed), "together" (one gust pushes, turns and lifts), "days" (each run its own).
    force, moment_xy, moment_z: std [N, N m] on the paper's vehicle; on others the same share of
        weight and the same angular accelerations.
    memory: s, of the forces and of the moments.
    wind: m/s, of "dryden": its mean over the ground at 6 m, which the turbulence drifts by with.
    every: s, mean time between single gusts.
    frequency: Hz, of "shedding": of the three forces and the three moments.
    trim_thrust, trim_torque: random walks of both thrusts and of a torque, share per s^1/2.
    jitter: rad/s at the paper's speeds, std of the rotor speeds; jitter_memory: s.
    jitter_reaction: share of the rotors' angular momentum that the body then takes up.
    """

    gusts: str = "none"
    force: float = 0.2
    moment_xy: float = 0.006
    moment_z: float = 0.003
    memory: tuple[float, float] = (0.5, 0.5)
    wind: float = 3.0
    every: float = 3.0
    frequency: tuple[float, ...] = (0.6, 0.8, 1.1, 0.5, 0.9, 0.7)
    trim_thrust: float = 0.0
    trim_torque: float = 0.0
    jitter: float = 0.0
    jitter_memory: float = 0.05
    jitter_reaction: float = 1.0


STILL = Air()
GUSTY = Air("markov")


def disturbances(
    air: Air, craft: Craft, rows: int, substeps: int, step: float, rng: np.random.Generator
) -> np.ndarray:
    """A history of rows * substeps steps of `step` s, and one more."""
    steps = rows * substeps
    history = np.zeros((steps + 1, DISTURBANCES))
    if air.gusts != "none":
        GUSTS[air.gusts](history, air, _levels(air, craft), step, (rows, substeps), rng)
    for column, level in ((6, air.trim_thrust), (7, air.trim_torque)):
        if level > 0.0:
            walk = level * math.sqrt(step) * rng.standard_normal(steps + 1)
            history[:, column] = np.cumsum(walk)
    if air.jitter > 0.0:
        std = air.jitter * rotors_of(craft).hover_upper / rotors_of(LAMA).hover_upper
        white = rng.standard_normal((steps, 2))
        history[1:, 8:10] = remembered(white, std, air.jitter_memory, step)
    return history


def remembered(white: np.ndarray, std: float, memory: float, step: float) -> np.ndarray:
    """White noise, unit, with an exponential memory [s] and a std."""
    decay = math.exp(-step / memory)
    drive = math.sqrt(1.0 - decay * decay)
    return lfilter([drive * std], [1.0, -decay], white, axis=0)


def _levels(air: Air, craft: Craft) -> np.ndarray:
    """Std of the six [N, N m] on a craft."""
    force = air.force * (craft.mass * craft.gravity / (LAMA.mass * LAMA.gravity))
    roll = air.moment_xy * (craft.inertia_x / LAMA.inertia_x)
    yaw = air.moment_z * (craft.inertia_z / LAMA.inertia_z)
    return np.array([force, force, force, roll, roll, yaw])


def _memories(air: Air) -> list[float]:
    return [air.memory[0]] * 3 + [air.memory[1]] * 3


def _markov(history, air, levels, step, shape, rng) -> None:
    _exponential(history, air, levels, step, rng.standard_normal((*shape, 6)))


def _heavy_tails(history, air, levels, step, shape, rng) -> None:
    """Each tenth of a second has its own std, so that what shakes it is Student's t, three degrees of
    freedom: shocks of t at 2 ms would be averaged to a Gauss by the memory."""
    white = rng.standard_normal((*shape, 6)).reshape(-1, 6)
    long = max(round(0.1 / step), 1)
    spread = 1.0 / np.sqrt(rng.chisquare(3.0, (-(-len(white) // long), 6)))
    _exponential(history, air, levels, step, white * np.repeat(spread, long, axis=0)[: len(white)])


def _exponential(history, air, levels, step, white) -> None:
    white = white.reshape(-1, 6)
    for i, (std, memory) in enumerate(zip(levels.tolist(), _memories(air), strict=True)):
        history[1:, i] = remembered(white[:, i], std, memory, step)


def _one_minus_cosine(history, air, levels, step, shape, rng) -> None:
    """Single gusts 0.5 A (1 - cos(2 pi t / T)), T from 0.3 to 3 s, on each axis in its own time, over
    a fifth of the usual unrest."""
    _exponential(history, air, 0.2 * levels, step, rng.standard_normal((*shape, 6)))
    end = len(history) * step
    for i, std in enumerate(levels.tolist()):
        at = float(rng.exponential(air.every))
        while at < end:
            length = float(rng.uniform(0.3, 3.0))
            peak = float(rng.choice([-1.0, 1.0]) * rng.uniform(1.5, 4.0)) * std
            first, last = math.ceil(at / step), min(math.ceil((at + length) / step), len(history))
            t = step * np.arange(first, last) - at
            history[first:last, i] += 0.5 * peak * (1.0 - np.cos(2.0 * math.pi * t / length))
            at += length + float(rng.exponential(air.every))


def _dryden(history, air, levels, step, shape, rng) -> None:
    """MIL-F-8785C at low altitude: 1.6 m above ground, drifting by with the mean wind.

    Along the wind a first-order spectrum of length L_u, across and down second-order ones of lengths
    L_u and h, their stds in the standard's proportions; turned to a random direction over ground. The
    moments are those of the field's gradients over the rotor: first-order, of length 4 b / pi.
    """
    feet = 1.6 * FEET
    long = feet / (0.177 + 0.000823 * feet) ** 1.2 / FEET  # m
    more = 1.0 / (0.177 + 0.000823 * feet) ** 0.4  # sigma_u / sigma_w
    white = rng.standard_normal((len(history), 6))
    down = levels[2]
    along = remembered(white[:, 0], more * down, long / air.wind, step)
    across = _second_order(white[:, 1], more * down, long / air.wind, step)
    angle = float(rng.uniform(0.0, 2.0 * math.pi))
    history[:, 10] = math.cos(angle) * along - math.sin(angle) * across
    history[:, 11] = math.sin(angle) * along + math.cos(angle) * across
    history[:, 12] = _second_order(white[:, 2], down, feet / FEET / air.wind, step)
    for i in range(3, 6):
        history[:, i] = remembered(white[:, i], levels[i], 0.3 / air.wind, step)


def _second_order(white: np.ndarray, std: float, time: float, step: float) -> np.ndarray:
    """Noise through (1 + sqrt(3) T s) / (1 + T s)^2, the standard's for the cross-wind components."""
    decay = math.exp(-step / time)
    once = lfilter([1.0 - decay], [1.0, -decay], white)
    twice = lfilter([1.0 - decay], [1.0, -decay], once)
    shaped = math.sqrt(3.0) * once + (1.0 - math.sqrt(3.0)) * twice
    # variance of the continuous filter is 1 / T per unit density, that of `white` 1 / step
    return std * math.sqrt(time / step) * shaped


def _shedding(history, air, levels, step, shape, rng) -> None:
    """Lightly damped oscillations, as behind a pillar or a fan: a tenth of critical damping."""
    white = rng.standard_normal((*shape, 6)).reshape(-1, 6)
    for i, (std, frequency) in enumerate(zip(levels.tolist(), air.frequency, strict=True)):
        turn = 2.0 * math.pi * frequency * step
        decay = math.exp(-0.1 * turn)
        poles = [1.0, -2.0 * decay * math.cos(turn), decay * decay]
        shaken = lfilter([1.0], poles, white[:, i])
        history[1:, i] = std * shaken / _std_of(poles)


def _std_of(poles) -> float:
    """Of unit white noise through 1 / (1 + a z^-1 + b z^-2), when it has settled."""
    _, a, b = poles
    return math.sqrt((1.0 + b) / ((1.0 - b) * ((1.0 + b) ** 2 - a * a)))


def _broad(history, air, levels, step, shape, rng) -> None:
    """Three memories two octaves and more apart, of equal variance: no single one is right."""
    for memory in (0.05, 0.4, 3.0):
        white = rng.standard_normal((*shape, 6)).reshape(-1, 6)
        for i, std in enumerate(levels.tolist()):
            history[1:, i] += remembered(white[:, i], std / math.sqrt(3.0), memory, step)


def _fitful(history, air, levels, step, shape, rng) -> None:
    """Gusts of one memory, a third as strong and twice as strong in turns of 1 to 6 s: a door."""
    _exponential(history, air, levels, step, rng.standard_normal((*shape, 6)))
    at, strong = 0, bool(rng.integers(2))
    while at < len(history):
        end = at + round(float(rng.uniform(1.0, 6.0)) / step)
        history[at:end, :6] *= 2.0 if strong else 1.0 / 3.0
        at, strong = end, not strong


def _one_sided(history, air, levels, step, shape, rng) -> None:
    """Log-normal, less its mean: long lulls, and gusts that come from one side, another on each axis
    and in each run."""
    steps = len(history) - 1
    white = rng.standard_normal((steps, 6))
    for i, (std, memory) in enumerate(zip(levels.tolist(), _memories(air), strict=True)):
        gauss = remembered(white[:, i], 0.8, memory, step)
        mean, square = math.exp(0.32), math.exp(0.64)
        skewed = (np.exp(gauss) - mean) / (mean * math.sqrt(square - 1.0))
        history[1:, i] = float(rng.choice([-1.0, 1.0])) * std * skewed


def _together(history, air, levels, step, shape, rng) -> None:
    """A gust that pushes to a side also turns the body, and lifts: nine tenths of moments and a half of
    the vertical force are those of the side force."""
    _exponential(history, air, levels, step, rng.standard_normal((*shape, 6)))
    for i, source, share in ((4, 0, -0.9), (3, 1, 0.9), (5, 1, 0.6), (2, 0, 0.5)):
        of_gust = share * levels[i] / levels[source] * history[:, source]
        history[:, i] = of_gust + math.sqrt(1.0 - share * share) * history[:, i]


def _days(history, air, levels, step, shape, rng) -> None:
    """Each run on its own day: a quarter to twice the strength, a third to three times the memory."""
    strength = math.exp(rng.uniform(math.log(0.25), math.log(2.0)))
    slower = math.exp(rng.uniform(-math.log(3.0), math.log(3.0)))
    air = air._replace(memory=(slower * air.memory[0], slower * air.memory[1]))
    _exponential(history, air, strength * levels, step, rng.standard_normal((*shape, 6)))


GUSTS = {
    "markov": _markov, "heavy_tails": _heavy_tails, "one_minus_cosine": _one_minus_cosine,
    "dryden": _dryden, "shedding": _shedding, "broad": _broad, "fitful": _fitful,
    "one_sided": _one_sided, "together": _together, "days": _days,
}  # fmt: skip
