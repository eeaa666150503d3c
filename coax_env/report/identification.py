"""The report of an identification: parameters before and after, and what ties them together."""

from collections.abc import Sequence

from scipy.stats import chi2

from coax_env.estimation.prediction import RunReplay
from coax_env.identification.maximum_likelihood import RunEstimate
from coax_env.logs.flight import Flight
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import and_list, capital, channel_name, number, plain, with_std
from coax_env.report import figures
from coax_env.report.flown import data_blocks, ordered, points_each, prediction_figure
from coax_env.report.page import (
    Section,
    bullets,
    callout,
    chooser,
    command,
    figure,
    page,
    prose,
    table,
)

DOUBT = 0.001
"""Chance below which a run disagrees with the others."""
TIED = 0.95
"""Correlation from which two parameters count as known only together."""


def identification_page(
    before: Vehicle,
    after: Vehicle,
    fitted: Sequence[str],
    *,
    flight: Flight | None = None,
    replay_before: Sequence[RunReplay] = (),
    replay_after: Sequence[RunReplay] = (),
    remarks: Sequence[str] = (),
    undetermined: Sequence[str] = (),
    directions: Sequence[str] = (),
    by_run: Sequence[RunEstimate] = (),
    command_line: str = "",
) -> str:
    """The report as HTML text.

    Args:
        fitted: full names of the fitted parameters. remarks: warnings to show beside them.
        undetermined, directions, by_run: of the `Identification`.
        replay_before, replay_after: the same runs flown again by each vehicle, if they were.
    """
    known = before.values()
    rows, moves = [], {}
    for name in fitted:
        new = after[name]
        old = before[name] if name in known else None
        if old is not None and old.std > 0.0:
            moves[plain(name)] = ((new.value - old.value) / old.std, new.std / old.std)
        shift, left = moves.get(plain(name), (None, None))
        rows.append(
            [
                plain(name),
                with_std(old.value, old.std, old.unit) if old is not None else "–",
                with_std(new.value, new.std, new.unit),
                "–" if shift is None else f"{shift:+.1f}".replace("-", "−"),
                "–" if left is None else f"{100 * left:.0f} %",
            ]
        )
    sentences = []
    if moves:
        most = max(moves, key=lambda n: abs(moves[n][0]))
        sentences.append(
            f"{capital(most)} moved most: by {number(abs(moves[most][0]), 2)} standard deviations "
            "of its prior."
        )
    tied = _tied(after)
    if tied:
        sentences.append("Known only together: " + "; ".join(tied) + ".")
    if undetermined:
        sentences.append(
            f"{len(undetermined)} of them these flights do not determine: "
            f"{and_list([plain(n) for n in undetermined])}."
        )
    header = ["parameter", "before", "after", "move / prior std", "std left"]
    parameters = [
        figure(figures.parameter_moves(moves), "Green: within one std of the prior.")
        if moves
        else "",
        table(header, rows),
        *(
            [prose("Combinations that the flights leave open:"), bullets(directions)]
            * bool(directions)
        ),
        *(callout(remark, "warning") for remark in remarks),
    ]
    parts = [Section("Parameters", parameters)]
    if len(by_run) > 1:
        parts.append(Section("From run to run", _repeatability(after, by_run)))
    if after.correlation is not None and len(after.correlated) > 1:
        names = [plain(n) for n in after.correlated]
        text = [[f"{c:.2f}" for c in row] for row in after.correlation]
        map_ = figures.heat_map(names, names, after.correlation, text, "correlation", centred=True)
        caption = "Near 1 or −1 two parameters are known only together."
        parts.append(Section("What cannot be told apart", [figure(map_, caption)]))
    if flight is not None and replay_before:
        later = {run.name: run for run in replay_after}
        options = {
            (run.name, channel_name(c)): prediction_figure(
                flight,
                run.name,
                c,
                {"before": run, "after": later.get(run.name)},
                flight.noise.get(c),
                points_each(sum(len(run.channels) for run in replay_before)),
            )
            for run in replay_before
            for c in ordered(run.channels)
        }
        parts.append(Section("Seen in flight", [chooser(options)]))
    if flight is not None:
        parts.append(Section("The data", data_blocks(flight)))
    if command_line:
        parts.append(Section("How this was computed", [command(command_line)]))
    return page(
        f"{len(fitted)} parameters of {before.name} fitted",
        sentences,
        parts,
        kicker=f"Identification · vehicle {before.name}",
    )


def _repeatability(after: Vehicle, by_run: Sequence[RunEstimate]) -> list[str]:
    names = dict.fromkeys(n for run in by_run for n in run.values)
    joint = {plain(n): (after[n].value, after[n].std) for n in names}
    alone = {run.run: {plain(n): (run.values[n], run.std[n]) for n in run.values} for run in by_run}
    rows = []
    for run in by_run:
        chance = chi2.sf(run.chi_square, run.degrees) if run.degrees else 1.0
        agrees = "–" if not run.degrees else ("yes" if chance > DOUBT else "**no**")
        rows.append([run.run, str(run.degrees), f"{run.chi_square:.1f}", agrees])
    blocks = [
        prose("Each run fitted alone, by one step from the joint estimate, against all together.")
    ]
    if joint:
        blocks.append(figure(figures.repeatability(joint, alone), "Only what a run determines."))
    header = ["run", "numbers it determines", "chi square about the joint estimate", "agrees"]
    return [*blocks, table(header, rows, f"Agrees: not beyond chance at {100 * DOUBT:g} %.")]


def _tied(vehicle: Vehicle) -> list[str]:
    """Pairs of parameters too correlated to be known apart, in words."""
    if vehicle.correlation is None:
        return []
    return [
        f"{plain(vehicle.correlated[j])} with {plain(a)} ({vehicle.correlation[i, j]:.2f})"
        for i, a in enumerate(vehicle.correlated)
        for j in range(i)
        if abs(vehicle.correlation[i, j]) > TIED
    ]
