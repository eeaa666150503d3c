"""The report of a diagnosis: what the simulation got wrong, why, and what mending it is worth."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from coax_env import effects, figures
from coax_env.engine.whiteness import SHARE
from coax_env.generic_terms import AXES, TERMS
from coax_env.plain_words import (
    and_list,
    capital,
    channel_name,
    consequence,
    number,
    outside_usual,
    plain,
    seconds,
    title,
    unit_name,
    whole_percent,
    with_std,
)
from coax_env.prediction import RunReplay, rms
from coax_env.report.flown import data_blocks, ordered, points_each, prediction_figure
from coax_env.report.page import (
    Section,
    callout,
    card,
    cards,
    chooser,
    command,
    details,
    figure,
    page,
    prose,
    side_by_side,
    table,
    tiles,
)
from coax_env.vehicle import Vehicle

if TYPE_CHECKING:
    from coax_env.diagnosis import Diagnosis

Findings = Mapping[str, Any]
MOST_INNOVATION_FIGURES = 60


def diagnosis_page(result: "Diagnosis", command_line: str = "") -> str:
    """The report of one diagnosis as HTML text; `command_line` is what was typed."""
    findings = result.findings
    parts = [
        Section("What was missing", _causes(findings, result.vehicle_before)),
        Section("What it changes", _gain(findings)),
        Section("Seen in flight", _seen(result)),
        Section("What is left", _left(findings, result.vehicle_before)),
        Section("How sure is this", _sure(result)),
        Section("The data", data_blocks(result.flight, result.remarks, result.noise)),
        Section("How this was computed", _computed(result, command_line)),
    ]
    where = result.flight.path.name if result.flight.path else "without a folder"
    return page(
        headline(findings),
        lead(findings),
        [part for part in parts if any(part.blocks)],
        kicker=f"Diagnosis · flight {where} · vehicle {result.vehicle_before.name} · "
        f"{len(result.flight.runs)} runs",
    )


def headline(findings: Findings) -> str:
    """The verdict in one sentence."""
    names = [plain(c["effect"]) for c in findings["causes"]]
    verb = "explains" if len(names) == 1 else "explain"
    if findings["verdict"] == "consistent":
        return "The simulation agrees with these flights"
    if findings["verdict"] == "explained":
        return f"{capital(and_list(names))} {verb} what the simulation got wrong"
    if findings["verdict"] == "partly explained":
        return f"{capital(and_list(names))} {verb} a part; something else is left"
    return "The simulation misses something that no known effect explains"


def lead(findings: Findings) -> list[str]:
    """What a reader in a hurry takes away."""
    sentences = []
    gain = findings.get("gain")
    if findings["verdict"] == "consistent":
        sentences.append("What remains is sensor noise and gusts: no effect is worth adding.")
    if gain and findings["causes"]:
        sentences.append(
            f"On runs that the fit has not seen ({and_list(list(gain['held_out']))}), the extended "
            f"model removes **{whole_percent(gain['error_removed_percent'])}**{_interval(gain)} of "
            f"the error of a {seconds(gain['horizon_s'])} prediction. Refitting the bare model's "
            f"own numbers alone would remove {whole_percent(gain['refitted_base_percent'])}; no "
            f"model could remove more than {whole_percent(gain['noise_floor_percent'])} with these "
            "sensors."
        )
        if gain.get("black_box_percent") is not None:
            sentences.append(
                f"A black box of {len(AXES) * len(TERMS)} generic terms, fitted to the same runs, "
                f"removes {whole_percent(gain['black_box_percent'])}."
            )
    elif not gain:
        sentences.append("No run was held out, so how well this predicts is not known.")
    twins = sorted({t for c in findings["causes"] for t in c["confusable_with"]})
    if twins:
        sentences.append(
            f"These flights cannot tell everything apart: {and_list([plain(t) for t in twins])} "
            "could stand in for a cause named here."
        )
    if findings["unexplained"]:
        where = list(dict.fromkeys(channel_name(u["channel"]) for u in findings["unexplained"]))
        sentences.append(f"Unexplained structure is left in {and_list(where)}.")
    return sentences


def _interval(gain: Mapping[str, Any]) -> str:
    low, high = gain["ci95"]
    if low is None or high is None:
        return ""
    return f" ({low:.0f} to {high:.0f} %, 95 % interval)".replace("-", "−")


# --- causes ---------------------------------------------------------------------------------------


def _causes(findings: Findings, vehicle: Vehicle) -> list[str]:
    if not findings["causes"]:
        return [prose("Nothing that these flights can show: no effect of the catalogue is named.")]
    return [cards(_cause(cause, vehicle) for cause in findings["causes"])]


def _cause(cause: Mapping[str, Any], vehicle: Vehicle) -> str:
    effect, twins = cause["effect"], cause["confusable_with"]
    own = {name.rpartition(".")[2]: p for name, p in cause["parameters"].items()}
    values = {name: p["value"] for name, p in own.items()}
    numbers = ", ".join(
        f"{plain(name)} {with_std(p['value'], p['std'], p['unit'])}" for name, p in own.items()
    )
    known = effect in effects.CATALOGUE
    odd = known and outside_usual(effect, values)
    meaning = consequence(effect, values, vehicle) if known else ""
    lines = [
        effects.CATALOGUE[effect].summary if known else "",
        f"Value: {numbers}." if meaning else "",
        f"Showed in {and_list([channel_name(c) for c in cause['channels']])}."
        if cause["channels"]
        else "",
        f"**These flights cannot tell it from {and_list([plain(t) for t in twins])}.**"
        if twins
        else "Cannot be mistaken for another effect on these flights.",
        "**Its size is outside the usual range: take the name with care.**" if odd else "",
    ]
    return card(
        title(effect),
        capital(meaning or numbers),
        lines,
        badge=f"evidence {number(cause['evidence'])} nats",
        kind="warning" if twins or odd else "",
    )


# --- gain -----------------------------------------------------------------------------------------


def _gain(findings: Findings) -> list[str]:
    gain = findings.get("gain")
    if not gain:
        return [prose("All runs were fitted (nothing held out): no gain can be measured.")]
    low, high = gain["ci95"]
    interval = "" if low is None else f"{low:.0f} to {high:.0f} %".replace("-", "−")
    channels = {c: gain["channels"][c] for c in ordered(gain["channels"])}
    horizon = seconds(gain["horizon_s"])
    rows = [
        [
            channel_name(c),
            unit_name(e["unit"]),
            number(e["before"]),
            number(e["before_refitted"]),
            number(e["after"]),
            " .. ".join(number(x) for x in e["ci95"]) if e.get("ci95") else "–",
            number(e["noise"]),
        ]
        for c, e in channels.items()
    ]
    header = ["channel", "unit", "before", "refitted", "after", "95 % interval", "noise"]
    return [
        tiles(
            [
                (whole_percent(gain["error_removed_percent"]), "of the error removed", interval),
                (
                    whole_percent(gain["refitted_base_percent"]),
                    "by refitting alone",
                    "the bare model's own numbers",
                ),
                (
                    whole_percent(gain["noise_floor_percent"]),
                    "is the most possible",
                    "at these sensors' noise",
                ),
                (str(len(gain["held_out"])), "runs held out", ", ".join(gain["held_out"])),
            ]
        ),
        figure(
            figures.gain_bars(channels),
            f"Error of a {horizon} prediction on the held-out runs, as a share of what it was "
            "before. Whisker: 95 % interval. The green mark is the sensor's own noise, which is in "
            "every bar: no model gets below it.",
        ),
        details("The same in numbers", table(header, rows)),
    ]


def _seen(result: "Diagnosis") -> list[str]:
    before = {run.name: run for run in result.replay_before}
    if not before:
        return []
    after = {run.name: run for run in result.replay_after}
    channels = ordered({c for run in before.values() for c in run.channels})
    gained = {
        (run, c): _improvement(before[run], after.get(run), c) for run in before for c in channels
    }
    best = max(channels, key=lambda c: sum(gained[run, c] for run in before))
    runs = sorted(before, key=lambda run: -gained[run, best])
    options = {
        (run, channel_name(c)): prediction_figure(
            result.flight,
            run,
            c,
            {"as given": before[run], "extended": after.get(run)},
            result.noise.get(c),
            points_each(len(runs) * len(channels)),
        )
        for run in runs
        for c in [best, *(c for c in channels if c != best)]
        if c in before[run].channels
    }
    lost = [name for name, run in before.items() if run.diverged]
    return [
        prose("The held-out runs, which the fit has not seen."),
        chooser(
            options,
            "Each point of a line is where the model, started a second earlier from the estimated "
            "state and flown with the recorded commands, expects the reading. Below: its error, "
            "with the sensor's noise as a band.",
        ),
        callout(
            f"The vehicle as given runs away in {and_list(lost)}: where its line ends it has left "
            "the figure.",
            "warning",
        )
        if lost
        else "",
    ]


def _improvement(before: RunReplay, after: RunReplay | None, channel: str) -> float:
    """Share by which the error of a channel fell in a run; 0 where that has no meaning."""
    if after is None or channel not in before.channels or channel not in after.channels:
        return 0.0
    errors = [run.channels[channel].error for run in (before, after)]
    if not all(np.isfinite(e).any() for e in errors):
        return 0.0
    old, new = (rms(e) for e in errors)
    return 1.0 - new / old if old > 0.0 else 0.0


# --- what is left ---------------------------------------------------------------------------------


def _left(findings: Findings, vehicle: Vehicle) -> list[str]:
    rows = [
        [
            channel_name(u["channel"]),
            f"{100 * u['share']:.0f} %",
            ", ".join(channel_name(d) for d in u["depends_on"]) or "not known",
            u.get("form") or "not known",
        ]
        for u in findings["unexplained"]
    ]
    caption = "Structure beyond noise and gusts that no effect of the catalogue explains"
    return [
        table(["channel", "share", "follows", "form"], rows, caption)
        if rows
        else callout("Nothing beyond noise and gusts is left in the innovations.", "good"),
        prose(_gust_words(findings["gusts"], vehicle)),
    ]


def _gust_words(gusts: Mapping[str, Any], vehicle: Vehicle) -> str:
    force = ", ".join(number(1000 * f, 2) for f in gusts["force_N"])
    moment = ", ".join(number(1000 * m, 2) for m in gusts["moment_Nm"])
    largest = max(gusts["force_N"]) / vehicle["mass"].value
    return (
        f"**Gusts.** Forces of {force} mN and moments of {moment} mN m (x, y, z; standard "
        f"deviation), forgotten within {seconds(gusts['memory_s'])}, are taken as noise: at most "
        f"{number(largest, 2)} m/s² of acceleration. They are estimated with the causes and never "
        "count as one."
    )


# --- how sure -------------------------------------------------------------------------------------


def _sure(result: "Diagnosis") -> list[str]:
    findings = result.findings
    blocks = [
        callout(
            f"{title(c['effect'])} cannot be told from "
            f"{and_list([plain(t) for t in c['confusable_with']])} on these flights.",
            "warning",
        )
        for c in findings["causes"]
        if c["confusable_with"]
    ]
    following = findings.get("next_maneuver")
    if following:
        parted = and_list([plain(s) for s in following["separates"]])
        blocks.append(
            callout(
                f"**Fly next: {plain(following['maneuver'])}.** It parts {parted}: "
                f"{following['why'].rstrip('.')}."
            )
        )
    rate = findings.get("false_alarm_rate")
    blocks.append(
        prose(
            f"Calibrated on clean synthetic flights: the threshold lets a false cause through in "
            f"{100 * rate:.2g} % of them."
            if rate is not None
            else "How often a cause is named where there is none has not been calibrated yet."
        )
    )
    pair = []
    if result.evidence_history:
        steps = [(_step_name(name), gain) for name, gain in result.evidence_history]
        pair.append(
            figure(
                figures.evidence_steps(steps),
                "The search, step by step: how much each raised the log-likelihood.",
            )
        )
    before, after = result.whiteness.get("before", {}), result.whiteness.get("after", {})
    shares = {
        c: (before[c].coloured_share, after[c].coloured_share)
        for c in ordered(before)
        if c in after
    }
    if shares:
        pair.append(
            figure(
                figures.whiteness_bars(shares, SHARE),
                "How much of what the model did not expect could have been expected. Left of the "
                "green line a channel counts as noise.",
            )
        )
    options = _innovation_figures(result, shares)
    return [
        *blocks,
        side_by_side(pair) if pair else "",
        details(
            "Innovations, run by run",
            chooser(
                options,
                "What each reading added to what the model knew already, in units of its own "
                "standard deviation. A level of 1 above, and nothing outside the band below, mean "
                "that the model misses nothing.",
            ),
        )
        if options
        else "",
    ]


def _step_name(step: str) -> str:
    """``+ rotor_drag`` as ``+ rotor drag``; only names of effects change."""
    return " ".join(plain(word) if word in effects.CATALOGUE else word for word in step.split())


def _innovation_figures(
    result: "Diagnosis", shares: Mapping[str, tuple[float, float]]
) -> dict[tuple[str, str], figures.Figure]:
    """Figures by run and channel, of each run those channels that were most coloured before."""
    options = {}
    runs = result.innovations_before
    each = max(3, MOST_INNOVATION_FIGURES // max(len(runs), 1))
    telling = {w.run: w.coloured_share for w in result.whiteness.get("before", {}).values()}
    for run in sorted(runs, key=lambda name: -telling.get(name, 0.0)):
        before, after = runs[run], result.innovations_after.get(run, {})
        channels = sorted(
            (c for c in ordered(before) if c in after),
            key=lambda c: -shares.get(c, (0.0, 0.0))[0],
        )
        for c in channels[:each]:
            options[run, channel_name(c)] = figures.innovations(before["t"], before[c], after[c])
    return options


# --- how computed ---------------------------------------------------------------------------------


def _computed(result: "Diagnosis", command_line: str) -> list[str]:
    changed = changed_parameters(result.vehicle_before, result.vehicle_after)
    return [
        command(command_line) if command_line else "",
        prose(
            "One extended Kalman filter of the full model runs over each run. Every effect of the "
            "catalogue is moved a little, and its mark on the innovations is compared with what is "
            "left unexplained. The best is added, everything is fitted again, and causes already "
            "chosen are dropped or exchanged where that helps. Base parameters keep their priors. "
            "Causes and gain come from the runs that were not held out; the vehicle file is then "
            "fitted on all runs with the same structure."
        ),
        details(
            f"{len(changed)} numbers of the vehicle file changed",
            table(["parameter", "before", "after"], changed),
        )
        if changed
        else "",
    ]


def changed_parameters(before: Vehicle, after: Vehicle) -> Sequence[Sequence[str]]:
    """Parameters whose value differs: name, before, after with std."""
    old = before.values()
    return [
        [plain(name), number(old.get(name, math.nan), 4), with_std(p.value, p.std, p.unit)]
        for name in after.values()
        if (p := after[name]).value != old.get(name)
    ]
