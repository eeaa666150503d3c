"""Closed-loop responses to a step of the setpoint, of the linear plant and the multi-rate filter."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from coax_env.env.period import DT
from coax_env.model.layout import FULL_STATES
from coax_env.model.sampling import is_new
from coax_env.model.sensors import suite
from controllers.lqr import LQG
from controllers.margins import Design

STEPS = {"z": -0.2, "psi": 0.2, "u": 0.3, "v": 0.3, "x": 0.3, "y": 0.3}
"""State and the step of what is asked for [SI]; small enough for the actions not to clip."""
WORDS = {
    "z": "height", "psi": "heading", "u": "speed forward", "v": "speed to the right", "x": "north",
    "y": "east",
}  # fmt: skip
_UNITS = dict(FULL_STATES)


@dataclass(frozen=True)
class StepResponse:
    """What a step of one setpoint makes of it; time from the step on."""

    name: str
    unit: str
    size: float
    t: np.ndarray  # [s] (n,)
    value: np.ndarray  # in `unit`, (n,)
    rise_s: float  # from a tenth to nine tenths
    overshoot_percent: float
    settling_s: float  # from then on within 5 %


def step_responses(controller: Design, seconds: float = 15.0) -> list[StepResponse]:
    """Responses to STEPS of what the controller observes and holds, without noise.

    A speed is not held where the sensors show no position (its integral is): it returns to nought.

    Args:
        controller: the design.
        seconds: duration.
    """
    design = controller.estimator
    held = {"z", "psi"} | ({"x", "y"} if "x" in design.states else set())
    return [
        _response(controller, name, size, seconds)
        for name, size in STEPS.items()
        if name in held & set(design.states)
    ]


def _response(controller: Design, name: str, size: float, seconds: float) -> StepResponse:
    """One step: plant and estimate both begin that far from the setpoint."""
    import control

    design = controller.estimator
    at = design.index(name)
    controller.reset(1)
    x, u = np.zeros(len(design.states)), np.zeros(4)
    x[at] = -size
    if isinstance(controller, LQG):  # the other takes it from the first reading
        controller.tracker.state[0, at] -= size
    values = []
    for row in range(round(seconds / DT)):
        values.append(size + x[at])
        observation = _observation(controller, design.C @ x + design.D @ u, row)
        action = controller.act(observation[None])[0].astype(float)
        u = design.action_trim - design.command_trim + design.action_scale * action
        x = design.A @ x + design.B @ u
    value = np.array(values) * np.sign(size)
    t = DT * np.arange(len(value))
    facts: Mapping[str, float] = {"RiseTime": np.inf, "Overshoot": 0.0, "SettlingTime": np.inf}
    if value.max() > 0.9 * abs(size):
        facts = control.step_info(value, T=t, final_output=abs(size), SettlingTimeThreshold=0.05)
    return StepResponse(
        WORDS[name], _UNITS[name], abs(size), t, value,
        float(facts["RiseTime"]), float(facts["Overshoot"]), float(facts["SettlingTime"]),
    )  # fmt: skip


def _observation(controller: Design, deviation: np.ndarray, row: int) -> np.ndarray:
    """What the env would show of readings (m,) about trim, without noise."""
    design = controller.estimator
    rates = {sensor.name: sensor.rate for sensor in suite(design.sensors)}
    size = 1 + max(int(design.reading_places.max()), int(design.flag_places.max()))
    found = np.zeros(max(size, len(rates)))
    found[design.reading_places] = design.reading_trim + deviation
    for name, flag in zip(design.readings, design.flag_places, strict=True):
        if flag >= 0:
            found[flag] = float(is_new(row, rates[name]))
    return found
