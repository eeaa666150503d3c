"""The report of simulated maneuvers: figures like the paper's 3-10, and its doublet as a table."""

from collections.abc import Sequence

import numpy as np

from coax_env.model.layout import RPM_PER_RAD_S
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import and_list, capital, number, plain
from coax_env.report import figures
from coax_env.report.page import (
    Section,
    bullets,
    command,
    details,
    figure,
    page,
    prose,
    side_by_side,
    table,
)
from coax_env.simulation.paper_doublet import REDUCED_K_B, DoubletRow, Remark
from coax_env.simulation.simulate import Track

Panel = tuple[str, dict[str, np.ndarray]]
"""Axis title and curves by name."""

POINTS = 3600
"""Per curve, all maneuvers of a page together: it is to stay under 5 MB."""

DOUBLET_HEADER = (
    "quantity", "unit", "paper prints", "its equations", "this run, K_b 0.91", "agrees",
    "fits paper", f"K_b {REDUCED_K_B}", "fits paper",
)  # fmt: skip


def simulation_page(
    tracks: Sequence[Track],
    vehicle: Vehicle,
    doublet: Sequence[DoubletRow] = (),
    remarks: Sequence[Remark] = (),
    command_line: str = "",
) -> str:
    """The report as HTML text.

    Args:
        tracks: what was flown, one per maneuver.
        vehicle: what flew.
        doublet: the paper's doublet as a table; empty where that was not flown.
        remarks: the paper's statements about it, checked; empty likewise.
        command_line: what was typed.
    """
    sentences = [f"{capital(t.maneuver.summary)}." for t in tracks]
    sentences += [f"**{capital(t.ended)}.**" for t in tracks if t.ended]
    top = f"Simulated: {and_list([plain(t.maneuver.name) for t in tracks])}"
    parts = []
    if doublet:
        top = _doublet_headline(doublet)
        sentences.append(_doublet_lead(doublet))
        parts.append(Section("Against the paper", _doublet(doublet, remarks)))
    parts += [
        Section(capital(plain(t.maneuver.name)), _track(t, max(200, POINTS // len(tracks))))
        for t in tracks
    ]
    if command_line:
        parts.append(Section("How this was computed", [command(command_line)]))
    return page(top, sentences, parts, kicker=f"Simulation · vehicle {vehicle.name}")


# --- the paper's doublet --------------------------------------------------------------------------


def doublet_rows(doublet: Sequence[DoubletRow]) -> list[list[str]]:
    """The doublet table in words, under DOUBLET_HEADER."""
    return [
        [
            row.quantity, row.unit, row.paper, _span(row.equations, row.digits),
            _span(row.run, row.digits), "yes" if row.agrees else "NO",
            "yes" if row.fits_paper else "no", _span(row.reduced, row.digits),
            "yes" if row.reduced_fits_paper else "no",
        ]
        for row in doublet
    ]  # fmt: skip


def _span(values: tuple[float, float], digits: int) -> str:
    """``−0.12 .. 0.00``, or one number."""
    low, high = (f"{round(v, digits) + 0.0:.{digits}f}".replace("-", "−") for v in values)
    return low if low == high else f"{low} .. {high}"


def _doublet_headline(doublet: Sequence[DoubletRow]) -> str:
    agreeing = sum(row.agrees for row in doublet)
    missed = sum(not row.fits_paper for row in doublet)
    return (
        f"The paper's doublet: {agreeing} of {len(doublet)} quantities agree with its equations, "
        f"{missed} miss what it prints"
    )


def _doublet_lead(doublet: Sequence[DoubletRow]) -> str:
    missed = [row.quantity for row in doublet if not row.fits_paper]
    fitting = sum(row.reduced_fits_paper for row in doublet)
    how_many = "all" if fitting == len(doublet) else f"{fitting} of {len(doublet)}"
    return (
        f"With the printed tables {and_list(missed)} leave what the paper prints. With K_b = "
        f"{REDUCED_K_B} instead of 0.91, {how_many} fit: the paper's figures were probably made "
        "with another value than its Table III. That is inferred, not known."
    )


def _doublet(doublet: Sequence[DoubletRow], remarks: Sequence[Remark]) -> list[str]:
    caption = (
        "What the paper prints (a figure's axis, or its text), what its equations give, and this "
        "run. Agrees: within 2 %, or half the last digit printed."
    )
    checked = [
        f"{'Holds' if r.holds else '**Does not hold**'}: {r.statement} "
        f"(found {', '.join(number(f) for f in r.found)})."
        for r in remarks
    ]
    return [
        table(DOUBLET_HEADER, doublet_rows(doublet), caption),
        prose(
            "**Known**: the numbers of Tables I to IV and eqs (1)-(44), and that they leave the "
            "printed axes. **Inferred**: that the figures were made with a smaller linkage gain, "
            f"K_b = {REDUCED_K_B}: it brings every trace inside its axis, x and the height lost to "
            "the text's values. An amplitude of 3.7 deg would do the same."
        ),
        bullets(checked) if checked else "",
    ]


# --- histories ------------------------------------------------------------------------------------


def _track(track: Track, points: int) -> list[str]:
    """Histories of one maneuver, and its path from above."""
    motion = figures.histories(track.t, _motion(track), points)
    loads = figures.histories(track.t, _loads(track), points)
    above = figures.plan_view(track["x"], track["y"], -track["z"])
    return [
        side_by_side(
            [
                figure(motion, "Commands, body velocity, rates and attitude."),
                figure(loads, "Flaps, fly-bar, specific force and position."),
            ]
        ),
        details("From above", figure(above, "The track over the ground, north up.")),
    ]


def _motion(track: Track) -> list[Panel]:
    rpm = track.command[:, :2] * RPM_PER_RAD_S
    swash = np.rad2deg(track.command[:, 2:])
    return [
        ("rotors [rpm]", {"upper": rpm[:, 0], "lower": rpm[:, 1]}),
        ("swash [deg]", {"lon": swash[:, 0], "lat": swash[:, 1]}),
        ("velocity [m/s]", {name: track[name] for name in "uvw"}),
        ("rates [deg/s]", _degrees(track, "p", "q", "r")),
        ("attitude [deg]", _degrees(track, "phi", "theta", "psi")),
    ]


def _loads(track: Track) -> list[Panel]:
    return [
        ("lower flap [deg]", _degrees(track, "alpha_l", "beta_l")),
        ("fly-bar [deg]", _degrees(track, "alpha_f", "beta_f")),
        ("force / mass [m/s²]", {"a_x": track.reading("ax"), "a_y": track.reading("ay")}),
        ("force / mass [m/s²]", {"a_z": track.reading("az")}),
        ("position [m]", {"x": track["x"], "y": track["y"], "height": -track["z"]}),
    ]


def _degrees(track: Track, *names: str) -> dict[str, np.ndarray]:
    return {name: np.rad2deg(track[name]) for name in names}
