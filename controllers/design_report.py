"""The report of a controller design: margins, what it sees, and a flight, on one page."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from coax_env.env import hover
from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.model.layout import ATTITUDE, N_STATES, STATES
from coax_env.model.vehicle import Vehicle
from coax_env.report import figures
from coax_env.report.page import Section, bullets, command, figure, page, prose, table
from controllers.loading import Controller
from controllers.lqr import LQG, Margins, frequency_responses

MARGIN_HEADER = ("input", "gain down", "gain up", "phase", "least distance", "at")
START = {"z": -hover.HEIGHT + 0.5, "psi": 0.5, "phi": 0.08, "u": 0.5}
"""Start of the flight that is shown: too low, turned, tilted, moving. SI."""


def margin_rows(margins: list[Margins]) -> list[list[str]]:
    """The margins in words, under MARGIN_HEADER."""
    return [
        [
            m.input.replace("_", " "), f"x {m.gain_down:.2f}", f"x {m.gain_up:.1f}",
            f"{m.phase_deg:.0f} deg" if np.isfinite(m.phase_deg) else "any",
            f"{m.distance:.2f}", f"{m.crossover_hz:.1f} Hz",
        ]
        for m in margins
    ]  # fmt: skip


def design_page(
    controller: LQG,
    vehicle: Vehicle,
    margins: list[Margins],
    disk: float,
    score: dict[str, Any],
    worst: dict[str, Any],
    spread: np.ndarray,
    command_line: str = "",
) -> str:
    """The report as HTML text.

    `worst` is of `evaluate_spread`, `spread` of `lqr.margins_over_spread`, on the same vehicle.
    """
    gain, phase = disk_in_words(disk)
    lead = [
        f"Flown on {vehicle.name} with its own noisy {controller.sensors} sensors, "
        f"{score['episodes']} flights of {score['seconds']:.0f} s: "
        f"**{100 * score['success_rate']:.0f} % succeed**.",
        f"All four inputs at once may be off by {gain} in gain or {phase} in phase.",
        spread_in_words(worst, spread),
    ]
    omega, _, single = frequency_responses(controller)
    loops = dict(zip((m.input.replace("_", " ") for m in margins), single.T, strict=True))
    seen_band = omega > 0.06
    t, panels = step_response(controller, vehicle)
    blocks = [figure(figures.histories(t, panels), "From a start that is too low, turned, tilted")]
    seen = [f"{n}: {s:.2g}" for n, s in zip(controller.estimator.states,
            controller.estimator.spread, strict=True)]  # fmt: skip
    hidden = ", ".join(controller.estimator.unobserved) or "none"
    parts = [
        Section("Margins", [
            table(MARGIN_HEADER, margin_rows(margins), "One input at a time, the others closed"),
            figure(figures.bode(omega[seen_band], {n: r[seen_band] for n, r in loops.items()}),
                   "The loop of each input, the others closed"),
            prose("Of the loop with the single-rate equivalent of the multi-rate filter."),
        ]),
        Section("A flight", blocks),
        Section("What the filter knows", [
            prose(f"Not shown by these sensors, and left out: {hidden}. "
                  "Std of the estimation error, SI:"),
            bullets(seen),
        ]),
    ]  # fmt: skip
    if command_line:
        parts.append(Section("How this was computed", [command(command_line)]))
    return page(f"Hover controller for {vehicle.name}", lead, parts, kicker="Controller design")


def spread_in_words(worst: dict[str, Any], spread: np.ndarray) -> str:
    """What is left on the worst of the vehicles drawn from the file's spread."""
    gain, phase = disk_in_words(float(spread.min()))
    return (
        f"Worst of {len(worst['vehicles'])} vehicles drawn from the file's spread: "
        f"{100 * worst['success_rate']:.0f} % of the flights succeed, cost {worst['mean_cost']:.2g} "
        f"(median {np.median([v['mean_cost'] for v in worst['vehicles']]):.2g}); "
        f"of {len(spread)} more: {gain} in gain or {phase} in phase."
    )


def disk_in_words(disk: float) -> tuple[str, str]:
    """A disk margin as the gain factor and the phase it allows."""
    factor = (2.0 + disk) / (2.0 - disk) if disk < 2.0 else np.inf
    return f"a factor {factor:.1f}", f"{np.degrees(2.0 * np.arctan(disk / 2.0)):.0f} deg"


def step_response(
    controller: Controller, vehicle: Vehicle, seconds: float = 8.0
) -> tuple[np.ndarray, list[tuple[str, dict[str, np.ndarray]]]]:
    """True states of one flight from START on noisy sensors: time (n,) and panels of curves."""
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
        ("place [m]", {"north": x[:, 13], "east": x[:, 14]}),
        ("action [1]", dict(zip(("upper", "lower", "lon", "lat"), a.T, strict=True))),
    ]
