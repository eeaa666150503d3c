"""The report of an identification: parameters before and after, and how they are correlated."""

from collections.abc import Mapping, Sequence

from scipy.stats import chi2

from coax_env.estimation.prediction import RunReplay
from coax_env.identification.maximum_likelihood import RunEstimate
from coax_env.logs.flight import Flight
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import and_list, capital, channel_name, number, plain, with_std
from coax_env.report import figures, fit_figures
from coax_env.report.flight_data import data_blocks, ordered, points_each, prediction_figure
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

LEAST_CHANCE = 0.001
"""Probability of the chi square below which a run disagrees with the others."""
MOST_CORRELATION = 0.95
"""Above it two parameters count as known only together."""

Moves = Mapping[str, tuple[float, float]]
"""Parameter in words -> how far it moved, and its std after the fit, both in its prior's std."""


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
        before: the vehicle file as given.
        after: the fitted one.
        fitted: full names of the fitted parameters.
        flight: what was fitted, if it is to be shown.
        replay_before: the flight's runs predicted by `before`, if they were.
        replay_after: the same by `after`.
        remarks: warnings to show beside the parameters.
        undetermined: of the `Identification`.
        directions: of the `Identification`.
        by_run: of the `Identification`.
        command_line: what was typed.
    """
    moves = _moves(before, after, fitted)
    sections = [
        Section("Parameters", _parameters(before, after, fitted, moves, directions, remarks))
    ]
    if len(by_run) > 1:
        sections.append(Section("From run to run", _repeatability(after, by_run)))
    if after.correlation is not None and len(after.correlated) > 1:
        sections.append(Section("Correlation", _correlation(after)))
    if flight is not None and replay_before:
        shown = _predictions(flight, replay_before, replay_after)
        sections.append(Section("Predictions", [shown]))
    if flight is not None:
        sections.append(Section("The data", data_blocks(flight)))
    if command_line:
        sections.append(Section("How this was computed", [command(command_line)]))
    return page(
        f"{len(fitted)} parameters of {before.name} fitted",
        _lead(after, moves, undetermined),
        sections,
        kicker=f"Identification · vehicle {before.name}",
    )


def _moves(before: Vehicle, after: Vehicle, fitted: Sequence[str]) -> Moves:
    """Of those fitted parameters that had a prior."""
    known = before.values()
    return {
        plain(name): ((after[name].value - old.value) / old.std, after[name].std / old.std)
        for name in fitted
        if name in known and (old := before[name]).std > 0.0
    }


def _lead(after: Vehicle, moves: Moves, undetermined: Sequence[str]) -> list[str]:
    sentences = []
    if moves:
        most = max(moves, key=lambda n: abs(moves[n][0]))
        sentences.append(
            f"{capital(most)} moved most: by {number(abs(moves[most][0]), 2)} standard deviations "
            "of its prior."
        )
    correlated = _correlated_pairs(after)
    if correlated:
        sentences.append("Known only together: " + "; ".join(correlated) + ".")
    if undetermined:
        sentences.append(
            f"{len(undetermined)} of them these flights do not determine: "
            f"{and_list([plain(n) for n in undetermined])}."
        )
    return sentences


def _parameters(
    before: Vehicle,
    after: Vehicle,
    fitted: Sequence[str],
    moves: Moves,
    directions: Sequence[str],
    remarks: Sequence[str],
) -> list[str]:
    known = before.values()
    rows = []
    for name in fitted:
        old, new = before[name] if name in known else None, after[name]
        move, left = moves.get(plain(name), (None, None))
        rows.append(
            [
                plain(name),
                with_std(old.value, old.std, old.unit) if old is not None else "–",
                with_std(new.value, new.std, new.unit),
                "–" if move is None else f"{move:+.1f}".replace("-", "−"),
                "–" if left is None else f"{100 * left:.0f} %",
            ]
        )
    caption = "Bar: std after the fit. Green: within one std of the prior."
    blocks: list[str] = [figure(fit_figures.parameter_moves(moves), caption)] if moves else []
    blocks.append(table(["parameter", "before", "after", "move / prior std", "std left"], rows))
    if directions:
        undetermined = prose("Combinations that the flights do not determine:")
        blocks += [undetermined, bullets(directions)]
    return [*blocks, *(callout(remark, "warning") for remark in remarks)]


def _repeatability(after: Vehicle, by_run: Sequence[RunEstimate]) -> list[str]:
    """Each run's own estimate against the joint one."""
    names = dict.fromkeys(n for run in by_run for n in run.values)
    joint = {plain(n): (after[n].value, after[n].std) for n in names}
    alone = {run.run: {plain(n): (run.values[n], run.std[n]) for n in run.values} for run in by_run}
    rows = []
    for run in by_run:
        chance = chi2.sf(run.chi_square, run.degrees) if run.degrees else 1.0
        agrees = "–" if not run.degrees else ("yes" if chance > LEAST_CHANCE else "**no**")
        rows.append([run.run, str(run.degrees), f"{run.chi_square:.1f}", agrees])
    blocks: list[str] = [
        prose("Each run fitted alone, by one step from the joint estimate, against all together.")
    ]
    if joint:
        caption = "Only what a run determines."
        blocks.append(figure(fit_figures.repeatability(joint, alone), caption))
    header = ["run", "parameters it determines", "chi square about the joint estimate", "agrees"]
    caption = f"Agrees: not beyond chance at {100 * LEAST_CHANCE:g} %."
    return [*blocks, table(header, rows, caption)]


def _correlation(vehicle: Vehicle) -> list[str]:
    names = [plain(n) for n in vehicle.correlated]
    values = vehicle.correlation
    assert values is not None
    text = [[f"{c:.2f}" for c in row] for row in values]
    colours = figures.heat_map(names, names, values, text, "correlation", centred=True)
    return [figure(colours, "Near 1 or −1 two parameters are known only together.")]


def _correlated_pairs(vehicle: Vehicle) -> list[str]:
    """Pairs of parameters too correlated to be known apart, in words."""
    if vehicle.correlation is None:
        return []
    return [
        f"{plain(vehicle.correlated[j])} with {plain(a)} ({vehicle.correlation[i, j]:.2f})"
        for i, a in enumerate(vehicle.correlated)
        for j in range(i)
        if abs(vehicle.correlation[i, j]) > MOST_CORRELATION
    ]


def _predictions(
    flight: Flight, replay_before: Sequence[RunReplay], replay_after: Sequence[RunReplay]
) -> str:
    """The runs predicted before and after, by run and channel."""
    after = {run.name: run for run in replay_after}
    points = points_each(sum(len(run.channels) for run in replay_before))
    return chooser(
        {
            (run.name, channel_name(c)): prediction_figure(
                flight,
                run.name,
                c,
                {"before": run, "after": after.get(run.name)},
                flight.noise.get(c),
                points,
            )
            for run in replay_before
            for c in ordered(run.channels)
        }
    )
