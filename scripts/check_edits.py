"""Diagnose edits of a flight's log: each must be found at its size, and nothing else have changed.

With --since each holds from a moment on, which must be found too.
"""

import argparse
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import command_line

from coax_env.files import write_json

if TYPE_CHECKING:
    from coax_env.comparison.two_logs.before import Before
    from coax_env.comparison.two_logs.stated import Changes
    from coax_env.logs.flight import Flight

STANDARD = {
    "phase": 0.15, "delay": 0.03, "offset_lon": 0.03, "gain": 1.25, "rotor_scale": 1.04,
    "theta": 0.03,
}  # fmt: skip
"""What a log is made to say: sizes that matter in flight and are no fault."""
INTERVAL = 1.96  # std of a 95 % interval


@dataclass(frozen=True)
class Planted:
    """The change that a model of this form must find. parameters: name -> change, effective."""

    effect: str
    parameters: Mapping[str, float]


def main() -> None:
    from coax_env import read_flight

    options = arguments()
    log = read_flight(options.flight)
    with command_line.progress("edits") as report_progress:
        flight, before = before_edits(log, options.vehicle, report_progress)
        rows = check(flight, before, dict(options.edit), report_progress, options.since)
    write_json(options.out / "edits.json", rows)
    show(rows)
    if options.since is not None:
        in_time = sum(row["in_time"] for row in rows)
        print(f"{in_time} of {len(rows)} since the row of {options.since[0]}:{options.since[1]:g}")
    right = sum(row["found"] and not row["else"] for row in rows)
    print(f"{right} of {len(rows)} found at their size with nothing else; "
          f"{options.out / 'edits.json'}")  # fmt: skip


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("check_edits", __doc__)
    command_line.add_flight(parser)
    usual = " ".join(f"{name}={size:g}" for name, size in STANDARD.items())
    parser.add_argument(
        "--edit", action="append", type=_edit, metavar="NAME=SIZE",
        help=f"may be repeated (default: {usual})",
    )  # fmt: skip
    command_line.add_since(parser)
    options = parser.parse_args()
    options.edit = options.edit or list(STANDARD.items())
    return options


def _edit(text: str) -> tuple[str, float]:
    name, _, size = text.partition("=")
    if name not in PLANTED:
        raise argparse.ArgumentTypeError(
            f"no edit {name!r} to check; there are {', '.join(PLANTED)}"
        )
    try:
        return name, float(size)
    except ValueError:
        raise argparse.ArgumentTypeError(f"should be NAME=SIZE, found {text!r}") from None


def before_edits(
    log: "Flight", vehicle: str | None, report_progress: Callable[[str], None]
) -> tuple["Flight", "Before"]:
    """What a fit needs of a flight (`changes.calm`), and its model as it was logged.

    Args:
        log: the flight as read.
        vehicle: shipped name or path; None: the card's.
        report_progress: called with a line of text.
    """
    from coax_env import load_vehicle
    from coax_env.comparison.two_logs.before import Before, calm, fitted_model

    machine = load_vehicle(vehicle or log.vehicle).in_air(log.air)
    flight = calm(log, machine)
    return flight, Before.of(*fitted_model(flight, machine, progress=report_progress))


def check(
    flight: "Flight",
    before: "Before",
    edits: Mapping[str, float],
    report_progress: Callable[[str], None],
    since: tuple[str, float] | None = None,
) -> list[dict[str, Any]]:
    """Every edit of a flight, one at a time, and what the difference says.

    Args:
        flight, before: of `before_edits`.
        edits: name -> size.
        report_progress: called with a line of text.
        since: run and time [s] from which on each edit holds; None: in the whole flight.
    """
    from coax_env.comparison.two_logs.changes import changes
    from coax_env.estimation.helicopter import record_of
    from coax_env.logs.edits import edited

    rows = []
    for name, size in edits.items():
        report_progress(f"{name} {size:g}")
        records = [record_of(run) for run in edited(flight, {name: size}, since).runs]
        found = changes(before, records, report_progress)
        row = judged(name, size, PLANTED[name](size, before), found)
        if since is not None:
            row |= timed(since, found)
        rows.append(row)
    return rows


def timed(planted: tuple[str, float], found: "Changes") -> dict[str, Any]:
    """Whether the moment that was found is the planted one: within the rows that it lies between."""
    if found.since is None:
        return {"since": None, "in_time": False}
    run, t = planted
    half = math.sqrt(3.0) * found.since.std + 1e-9  # width of an even spread of that std
    right = found.since.moment.run == run and abs(found.since.t - t) <= half
    return {"since": found.since.entry(), "in_time": right}


def judged(name: str, size: float, planted: Planted, found: "Changes") -> dict[str, Any]:
    """One edit: whether it was found at its size, and what else changed.

    It is found where its effect is named, or one that these flights cannot tell from it, which is said.
    """
    own = [c for c in found.changes if planted.effect in (c.effect, *c.confusable_with)]
    named = own[0] if own else None
    table = {}
    good = named is not None
    if named is not None and named.effect == planted.effect:
        for parameter, change in planted.parameters.items():
            p = named.parameters[parameter]
            good = good and abs(p.change - change) <= INTERVAL * p.std
            table[parameter] = {
                "planted": change, "found": p.change, "std": p.std, "unit": p.unit
            }  # fmt: skip
    return {
        "edit": name,
        "size": size,
        "effect": planted.effect,
        "named": named.effect if named else None,
        "parameters": table,
        "found": good,
        "evidence": named.evidence if named else 0.0,
        "else": [c.effect for c in found.changes if c is not named],
        "different_nats": found.different,
        "left_nats": found.left,
        "all": found.as_json()["changes"],
    }


def show(rows: list[dict[str, Any]]) -> None:
    """The edits as a table."""
    lines = [["edit", "size", "number", "planted", "found", "std", "nats", "left", "also changed"]]
    for row in rows:
        first = [row["edit"], f"{row['size']:g}"]
        numbers = row["parameters"] or {row["named"] or "nothing": None}
        for number, p in numbers.items():
            cells = (
                ["", "", ""] if p is None
                else [f"{p['planted']:+.4f}", f"{p['found']:+.4f}", f"{p['std']:.4f}"]
            )  # fmt: skip
            worth = [f"{row['evidence']:.0f}", f"{row['left_nats']:.1f}"]
            lines.append([*first, number, *cells, *worth, ", ".join(row["else"]) or "-"])
            first = ["", ""]
    command_line.print_columns(lines)


# --- what each edit must look like -----------------------------------------------------------------


def _offset(axis: str) -> Callable[[float, "Before"], Planted]:
    def planted(size: float, before: "Before") -> Planted:
        angle = _phase(before)
        cosine, sine = math.cos(angle), math.sin(angle)
        lon, lat = (-cosine, -sine) if axis == "lon" else (sine, -cosine)
        return Planted(
            "swash_offset", {"swash_offset.lon": lon * size, "swash_offset.lat": lat * size}
        )

    return planted


def _phase(before: "Before") -> float:
    """The swash plate's phase [rad] of a model, at the mean speed of the lower rotor as flown."""
    import numpy as np

    from coax_env.model import generic_terms, state
    from coax_env.model.layout import RPM_PER_RAD_S

    values = before.fit.values
    _, hover = generic_terms.hover_speeds(before.problem.model.vector(values))
    passes = before.problem.engine.filter(values, before.fit.noise)
    flown = float(np.mean(np.concatenate([run.states[:, state.OMEGA_L] for run in passes])))
    per_rpm = values.get("swash_phase.per_rpm", 0.0)
    return values.get("swash_phase.angle", 0.0) + per_rpm * RPM_PER_RAD_S * (flown - hover)


def _scale(effect: str) -> Callable[[float, "Before"], Planted]:
    def planted(size: float, before: "Before") -> Planted:
        from coax_env.comparison.two_logs.coordinates import effective

        name = f"{effect}.scale"
        was = effective(before.problem, before.fit.values, effect)[name]
        return Planted(effect, {name: (1.0 + was) * (1.0 / size - 1.0)})

    return planted


def _plain(parameter: str, sign: float) -> Callable[[float, "Before"], Planted]:
    return lambda size, before: Planted(parameter.partition(".")[0], {parameter: sign * size})


PLANTED: Mapping[str, Callable[[float, "Before"], Planted]] = {
    "phase": _plain("swash_phase.angle", -1.0),
    "delay": _plain("servo_delay.time", 1.0),
    "offset_lon": _offset("lon"),
    "offset_lat": _offset("lat"),
    "gain": _scale("swash_gain"),
    "rotor_scale": _scale("rotor_speed"),
    "phi": _plain("attitude_bias.x", 1.0),
    "theta": _plain("attitude_bias.y", 1.0),
    "psi": _plain("attitude_bias.z", 1.0),
    "p_bias": _plain("gyro_bias.x", 1.0),
    "q_bias": _plain("gyro_bias.y", 1.0),
    "r_bias": _plain("gyro_bias.z", 1.0),
}
"""Edit -> the change that it must be found as, about a model of the log before."""


if __name__ == "__main__":
    command_line.run(main)
