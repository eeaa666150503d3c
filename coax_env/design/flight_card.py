"""A planned maneuver as a folder to fly from."""

from pathlib import Path

import numpy as np

from coax_env.design.next_maneuver import Design
from coax_env.files import write_text
from coax_env.logs.flight import Flight, Run, write_flight
from coax_env.model.layout import RPM_PER_RAD_S
from coax_env.simulation.maneuvers import ASKED, Maneuver
from coax_env.simulation.simulate import Track, fly


def write_flight_card(result: Design, flight: Flight, folder: str | Path) -> Path:
    """The best maneuver as a folder to fly from.

    ``card.toml`` and the run's CSV are a flight folder that `read_flight` reads: the commands that
    the simulated pilot gave on the first description. ``asked.csv`` is for a pilot or an autopilot:
    what to hold, and what to add to his own commands.

    Args:
        result: the design.
        flight: whose vehicle, air and noise go onto the card.
        folder: where it is written.
    """
    plan = result.ranked[0].maneuver
    flown = fly(result.alternatives[0].vehicle, plan)
    run = Run(plan.name, flown.t, flown.command, {}, plan.summary, instruction(plan))
    folder = write_flight(
        Flight(flight.vehicle, (run,), air=flight.air, noise=flight.noise), folder
    )
    write_text(folder / "asked.csv", asked_csv(plan, flown))
    return folder


def instruction(plan: Maneuver) -> str:
    """What a pilot does with a planned run, for the card's note."""
    what = "hold" if plan.injected else "fly"
    added = f" and add the steps on {', '.join(plan.injected)}" if plan.injected else ""
    return (
        f"planned, not flown: {what} height, speed and heading of asked.csv{added};"
        " the commands here are those of the simulated pilot"
    )


def asked_csv(plan: Maneuver, flown: Track) -> str:
    """Time, what to hold, and what to add to the pilot's own commands, row by row."""
    units = {"height": "m", "forward": "mps", "right": "mps", "heading": "rad"}
    header = ["t_s", *(f"{name}_{units[name]}" for name in ASKED)]
    header += ["add_rpm_upper", "add_rpm_lower", "add_delta_lon_rad", "add_delta_lat_rad"]
    added = plan.injection(flown.t, flown.command[0]) * [RPM_PER_RAD_S, RPM_PER_RAD_S, 1.0, 1.0]
    rows = np.column_stack([flown.t, plan.asked_for(flown.t), added])
    lines = [",".join(f"{value:.6g}" for value in row) for row in rows.tolist()]
    return "\n".join([",".join(header), *lines]) + "\n"
