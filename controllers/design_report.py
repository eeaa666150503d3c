"""The report of a controller design: margins, a flight, and the estimator, on one page."""

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from coax_env.env import hover
from coax_env.env.period import DT
from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.model.layout import ATTITUDE, FULL_STATES, N_STATES, STATES
from coax_env.model.sensors import suite
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import plain, unit_name
from coax_env.report import figures
from coax_env.report.page import Section, bullets, command, figure, page, prose, table
from controllers.loading import Controller
from controllers.lqr import HEDGE
from controllers.margins import (
    Design,
    InputMargins,
    WorstVehicle,
    frequency_responses,
    sensitivities,
)
from controllers.steps import StepResponse

MARGIN_HEADER = (
    "input", "gain margin down", "gain margin up", "phase margin", "least |1 + L|", "crossover",
)  # fmt: skip
BESIDE_HEADER = ("design", "disk margin", "cost", "disk margin with lags", "cost with lags")
SHOWN = (0.06, 0.9 * np.pi / DT)
"""Frequencies from and to which the loops are drawn [rad/s]; at the end, 50 Hz, gains go to nought."""
START = {"z": -hover.HEIGHT + 0.5, "psi": 0.5, "phi": 0.08, "u": 0.5}
"""Start of the flight that is shown: too low, turned, tilted, moving. SI."""


def margin_rows(margins: list[InputMargins]) -> list[list[str]]:
    """The margins in words, under MARGIN_HEADER."""
    return [
        [
            m.input.replace("_", " "), _decibels(m.gain_down), _decibels(m.gain_up),
            f"{m.phase_deg:.0f} deg" if np.isfinite(m.phase_deg) else "any",
            f"{m.distance:.2f}", f"{m.crossover_hz:.1f} Hz",
        ]
        for m in margins
    ]  # fmt: skip


def _decibels(gain: float) -> str:
    """A factor of the loop's gain in dB; any where there is no limit."""
    if not 0.0 < gain < np.inf:
        return "any"
    return f"{20.0 * np.log10(gain):+.1f} dB"


def design_page(
    controller: Design,
    vehicle: Vehicle,
    margins: list[InputMargins],
    disk: float,
    score: dict[str, Any],
    worst: dict[str, Any],
    spread: np.ndarray,
    steps: Sequence[StepResponse],
    command_line: str = "",
    extreme: WorstVehicle | None = None,
    beside: Sequence[Sequence[str]] = (),
) -> str:
    """The report as HTML text.

    Args:
        controller: the design.
        vehicle: what it was designed on.
        margins: of each input, from `stability_margins`.
        disk: margin of all inputs at once, from the same.
        score: of `evaluate` on the vehicle.
        worst: of `evaluate_spread` on it.
        spread: of `margins_over_spread` on it, (draws,).
        steps: of `step_responses`.
        command_line: what was typed.
        extreme: of `worst_over_spread` on it.
        beside: other designs, rows under BESIDE_HEADER.
    """
    gain, phase = disk_in_words(disk)
    lead = [
        f"Flown on {vehicle.name} with its own noisy {controller.sensors} sensors, "
        f"{score['episodes']} flights of {score['seconds']:.0f} s: "
        f"**{100 * score['success_rate']:.0f} % succeed**.",
        f"All four inputs at once may be off by {gain} in gain or by {phase} in phase.",
        spread_in_words(worst, spread),
        *([extreme_in_words(extreme)] if extreme else []),
    ]
    response = figures.histories(*step_response(controller, vehicle))
    sections = [
        *_beside_section(beside),
        Section("Margins", _margin_blocks(controller, margins)),
        Section("Sensitivity", _sensitivity_blocks(controller)),
        Section("Steps of the setpoint", _step_blocks(steps)),
        Section("A flight", [figure(response, "From a start that is too low, turned, tilted")]),
        Section("The estimator", _estimator_blocks(controller)),
    ]
    if command_line:
        sections.append(Section("How this was computed", [command(command_line)]))
    return page(f"Hover controller for {vehicle.name}", lead, sections, kicker="Controller design")


def _beside_section(beside: Sequence[Sequence[str]]) -> list[Section]:
    """Rows under BESIDE_HEADER, with what the lags are; nothing without rows."""
    lags = ", ".join(f"{plain(name)} {lag:g} s" for name, lag in HEDGE.items())
    note = f"Cost per step of 50 flights. With lags: {lags}"
    return [Section("Beside other designs", [table(BESIDE_HEADER, beside, note)])] if beside else []


def _margin_blocks(controller: Design, margins: list[InputMargins]) -> list[str]:
    """Margins as a table, and the loops as a Bode diagram."""
    omega, _, single = frequency_responses(controller)
    band = (omega > SHOWN[0]) & (omega < SHOWN[1])
    loops = {m.input.replace("_", " "): h[band] for m, h in zip(margins, single.T, strict=True)}
    return [
        table(MARGIN_HEADER, margin_rows(margins), "One input at a time, the others closed"),
        figure(figures.bode(omega[band], loops), "The loop of each input, the others closed"),
        prose("Of the loop with the single-rate equivalent of the multi-rate filter."),
    ]


def _sensitivity_blocks(controller: Design) -> list[str]:
    """S and T at the inputs over frequency, and their peaks."""
    omega, L, _ = frequency_responses(controller)
    S, T = sensitivities(L)
    band = (omega > SHOWN[0]) & (omega < SHOWN[1])
    curves = {"S": S[band], "T": T[band]}
    peaks = [
        f"{name}: largest {value.max():.2f} ({_decibels(value.max())}) at {hz:.1f} Hz"
        for name, value in (("S", S), ("T", T))
        for hz in (omega[value.argmax()] / (2.0 * np.pi),)
    ]
    crossings = omega[np.flatnonzero(np.diff(S >= 1.0))] / (2.0 * np.pi)
    below = f"Disturbances below {crossings[0]:.2f} Hz are damped." if len(crossings) else ""
    return [
        figure(
            figures.gains(omega[band], curves),
            "Largest singular values of S = (1 + L)^-1 and T = L S, all four inputs, actions as units",
        ),
        bullets(peaks),
        prose(below),
    ]


STEP_HEADER = ("setpoint", "step", "rise 10-90 %", "overshoot", "within 5 %")


def step_rows(responses: Sequence[StepResponse]) -> list[list[str]]:
    """The steps in words, under STEP_HEADER."""

    def after(seconds: float) -> str:
        return f"{seconds:.2f} s" if np.isfinite(seconds) else "later"

    return [
        [
            one.name, f"{one.size:g} {one.unit}", after(one.rise_s),
            f"{one.overshoot_percent:.0f} %", after(one.settling_s),
        ]
        for one in responses
    ]  # fmt: skip


def _step_blocks(responses: Sequence[StepResponse]) -> list[str]:
    """Responses to steps of what is held, and their figures."""
    panels = [(f"{one.name} [{one.unit}]", {one.name: one.value}) for one in responses]
    return [
        table(STEP_HEADER, step_rows(responses)),
        figure(figures.histories(responses[0].t, panels), "Linear plant, no noise"),
    ]


def extreme_in_words(extreme: WorstVehicle) -> str:
    """The vehicle that was looked for on purpose."""
    if not extreme.moves:
        return "The file has no spread: there is no worse vehicle to look for."
    gain, phase = disk_in_words(extreme.disk)
    named = ", ".join(f"{name} {move:+.1f} std" for name, move in list(extreme.moves.items())[:3])
    return (
        f"The least disk margin found within {np.linalg.norm(list(extreme.moves.values())):.0f} std of "
        f"the mean is {extreme.disk:.2f}: {gain} in gain or {phase} in phase ({named})."
    )


def _estimator_blocks(controller: Design) -> list[str]:
    """Std of the estimation error of each state, those of one unit in a row."""
    estimator = controller.estimator
    units = dict(FULL_STATES) | {f"bias_{s.name}": s.unit for s in suite(estimator.sensors)}
    found = zip(estimator.states, estimator.spread, strict=True)
    rows = [
        [", ".join(name for name, _ in group), ", ".join(f"{std:.2g}" for _, std in group), unit]
        for unit, members in groupby(found, key=lambda one: unit_name(units[one[0]]))
        for group in (list(members),)
    ]
    hidden = ", ".join(estimator.unobserved) or "none"
    return [
        prose(f"Not observable with these sensors, and left out: {hidden}."),
        table(("states", "std of the estimation error", "unit"), rows, "In the steady state"),
    ]


def spread_in_words(worst: dict[str, Any], spread: np.ndarray) -> str:
    """Score and disk margin of the worst of the vehicles drawn from the file's spread."""
    gain, phase = disk_in_words(float(spread.min()))
    return (
        f"Worst of {len(worst['vehicles'])} vehicles drawn from the file's spread: "
        f"{100 * worst['success_rate']:.0f} % of the flights succeed, cost {worst['mean_cost']:.2g} "
        f"(median {np.median([v['mean_cost'] for v in worst['vehicles']]):.2g}); "
        f"the loops of {len(spread)} more tolerate at least {gain} in gain or {phase} in phase."
    )


def disk_in_words(disk: float) -> tuple[str, str]:
    """A disk margin as the gain factor and the phase it allows."""
    factor = (2.0 + disk) / (2.0 - disk) if disk < 2.0 else np.inf
    return f"a factor {factor:.1f}", f"{np.degrees(2.0 * np.arctan(disk / 2.0)):.0f} deg"


def step_response(
    controller: Controller, vehicle: Vehicle, seconds: float = 8.0
) -> tuple[np.ndarray, list[tuple[str, dict[str, np.ndarray]]]]:
    """True states of one flight from START on noisy sensors.

    Args:
        controller: what flies.
        vehicle: what is flown.
        seconds: duration.

    Returns:
        time [s] (n,); axis title and curves (n,) by name, for `figures.histories`.
    """
    names = [name for name, _ in STATES]
    start = np.zeros(N_STATES)
    for name, value in START.items():
        start[names.index(name)] = value
    env = CoaxVectorEnv(
        1, vehicle, controller.nominal, controller.sensors, autoreset_mode=AutoresetMode.DISABLED
    )
    observations, info = env.reset(seed=0, options={"state": start})
    controller.reset(1)
    states, actions = [info["state"][0]], [np.zeros(4)]
    for _ in range(round(seconds / hover.CONTROL_PERIOD)):
        action = controller.act(observations)
        observations, _, _, _, info = env.step(action)
        states.append(info["state"][0])
        actions.append(action[0])
    x, a = np.array(states), np.array(actions)
    t = np.arange(len(x)) * hover.CONTROL_PERIOD
    degrees = np.degrees(x[:, ATTITUDE])
    return t, [
        ("height [m]", {"height": -x[:, 15]}),
        (
            "attitude [deg]",
            {"roll": degrees[:, 0], "pitch": degrees[:, 1], "heading": degrees[:, 2]},
        ),
        ("speed [m/s]", {"forward": x[:, 0], "right": x[:, 1], "down": x[:, 2]}),
        ("position [m]", {"north": x[:, 13], "east": x[:, 14]}),
        ("action [1]", dict(zip(("upper", "lower", "lon", "lat"), a.T, strict=True))),
    ]
