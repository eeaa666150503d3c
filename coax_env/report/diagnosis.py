"""The report of a diagnosis: what was flown, what the simulation got wrong, why, what mending is worth.

One page for someone who was not there: two minutes to read, the details folded away at its end.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from coax_env.estimation.prediction import RunReplay, rms
from coax_env.estimation.trajectories import RESTART, trajectories
from coax_env.estimation.whiteness import SHARE
from coax_env.model import effects
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import (
    and_list,
    capital,
    channel_name,
    count_word,
    number,
    plain,
    seconds,
    unit_name,
    whole_percent,
    with_std,
)
from coax_env.report import figures
from coax_env.report.causes import cause_blocks, look_alike_blocks
from coax_env.report.flight_view import flight_view
from coax_env.report.flown import data_blocks, ordered, points_each, prediction_figure
from coax_env.report.page import (
    Section,
    bullets,
    callout,
    chooser,
    command,
    details,
    figure,
    page,
    prose,
    side_by_side,
    table,
)
from coax_env.report.worth import FlownControllers, controller_blocks, gain_blocks, gain_tiles

if TYPE_CHECKING:
    from coax_env.diagnosis.diagnose import Diagnosis

Findings = Mapping[str, Any]
MOST_INNOVATION_FIGURES = 60
MOST_NAMED = 4
"""Causes in the headline; of more, the strongest."""
MOST_RUNS_NAMED = 12


def diagnosis_page(
    result: "Diagnosis", command_line: str = "", flown: FlownControllers | None = None
) -> str:
    """The report of one diagnosis as HTML text.

    Args:
        command_line: what was typed. flown: controllers of both models, where they were flown.
    """
    findings, before, after = result.findings, result.vehicle_before, result.vehicle_after
    parts = [
        Section("What was flown", _flown(result)),
        Section("Where the bare model departs", _departs(result)),
        Section("The causes", cause_blocks(findings, before, after)),
        Section("Look-alikes", look_alike_blocks(findings)),
        Section("What mending is worth", gain_blocks(findings)),
        Section("Still unexplained", _left(findings, before)),
        Section("Controllers before and after", controller_blocks(flown) if flown else []),
        Section("Details", _details(result, command_line)),
    ]
    where = result.flight.path.name if result.flight.path else "without a folder"
    return page(
        headline(findings),
        lead(findings),
        [part for part in parts if any(part.blocks)],
        kicker=f"Diagnosis · flight {where} · vehicle {before.name}",
        top=gain_tiles(findings) if findings["verdict"] != "consistent" else "",
    )


def headline(findings: Findings) -> str:
    """The verdict in one sentence."""
    names = [plain(c["effect"]) for c in findings["causes"]]
    verb = "explains" if len(names) == 1 else "explain"
    if len(names) > MOST_NAMED:
        named = f"{count_word(len(names))} effects, above all {and_list(names[:3])},"
    else:
        named = and_list(names) if names else ""
    if findings["verdict"] == "consistent":
        return "The simulation agrees with these flights"
    if findings["verdict"] == "explained":
        return f"{capital(named)} {verb} what the simulation got wrong"
    if findings["verdict"] == "partly explained":
        return f"{capital(named)} {verb} a part of what the simulation got wrong"
    return "The simulation misses something that no known effect explains"


def lead(findings: Findings) -> list[str]:
    """What a reader in a hurry takes away."""
    sentences = []
    gain = findings.get("gain")
    if findings["verdict"] == "consistent":
        sentences.append("What remains is sensor noise and gusts: no effect is worth adding.")
    if gain and findings["causes"]:
        sentences.append(
            f"With them in the model, **{whole_percent(gain['error_removed_percent'])}** of the "
            f"error of a {seconds(gain['horizon_s'])} prediction is gone on runs that the fit has "
            f"not seen ({and_list(list(gain['held_out']))})."
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


# --- what was flown -------------------------------------------------------------------------------


def _flown(result: "Diagnosis") -> list[str]:
    """The flights in a sentence, and to be looked at."""
    flight, before, after = result.flight, result.vehicle_before, result.vehicle_after
    total = sum(run.duration for run in flight.runs)
    names = list(flight.run_names[:MOST_RUNS_NAMED])
    if len(flight.runs) > MOST_RUNS_NAMED:
        names.append(f"{len(flight.runs) - MOST_RUNS_NAMED} more")
    held = {run.name for run in result.replay_before}
    models = {"bare": before} | ({"extended": after} if after.effects != before.effects else {})
    shown = trajectories(flight, after, models)
    shown.sort(key=lambda one: -float(one.parted().max()))
    place = (
        "measured"
        if "pn" in flight.channels
        else "what the estimator makes of the readings: no sensor shows it"
    )
    sensors = and_list([channel_name(c) for c in ordered(flight.channels)])
    count = f"{capital(count_word(len(flight.runs)))} run" + ("s" if len(flight.runs) > 1 else "")
    return [
        prose(f"{count} of a {before.name}, {total:.0f} s in all: {and_list(names)}."),
        flight_view(
            shown,
            dict(zip(models, (figures.BEFORE, figures.AFTER), strict=False)),
            before["rotor_radius"].value,
            held,
            f"Grey: as flown, its place {place}. The simulations are put onto it every "
            f"{seconds(RESTART)} and fly on by themselves with the recorded commands; the curves "
            "show how far off they get.",
        ),
        details("The runs and sensors", prose(f"Measured: {sensors}."), *data_blocks(
            flight, result.remarks, result.noise)),
    ]  # fmt: skip


# --- where it departs -----------------------------------------------------------------------------


def _departs(result: "Diagnosis") -> list[str]:
    """The bare model's predictions against the held-out runs, the worst channel first."""
    before = {run.name: run for run in result.replay_before}
    if not before:
        return []
    after = {run.name: run for run in result.replay_after}
    channels = ordered({c for run in before.values() for c in run.channels})
    gained = {
        (run, c): _improvement(before[run], after.get(run), c) for run in before for c in channels
    }
    compared = (result.findings["gain"] or {}).get("channels", {})
    telling = [c for c in channels if c in compared] or channels
    best = max(telling, key=lambda c: sum(gained[run, c] for run in before))
    runs = sorted(before, key=lambda run: -gained[run, best])
    options = {
        (run, channel_name(c)): prediction_figure(
            result.flight,
            run,
            c,
            {"bare": before[run], "extended": after.get(run)},
            result.noise.get(c),
            points_each(len(runs) * len(channels)),
        )
        for run in runs
        for c in [best, *(c for c in channels if c != best)]
        if c in before[run].channels
    }
    lost = [name for name, run in before.items() if run.diverged]
    return [
        prose(_worst_words(result.findings)),
        chooser(
            options,
            "Held-out runs. Each point of a line is where the model, started a second earlier from "
            "the estimated state and flown with the recorded commands, expects the reading. Below: "
            "its error, with the sensor's noise as a band.",
        ),
        callout(
            f"The bare model runs away in {and_list(lost)}: where its line ends it has left the "
            "figure.",
            "warning",
        )
        if lost
        else "",
    ]


def _worst_words(findings: Findings) -> str:
    """The channels in which the bare model's error stands out of the noise most."""
    gain = findings.get("gain")
    if not gain:
        return ""
    errors = {c: e for c, e in gain["channels"].items() if e["before"] is not None and e["noise"]}
    worst = sorted(errors, key=lambda c: -errors[c]["before"] / errors[c]["noise"])[:3]
    out = [c for c in worst if errors[c]["before"] > 1.1 * errors[c]["noise"]]
    if not out:
        return "Nowhere on the held-out runs does it stand out of the sensors' noise."
    words = [
        f"{channel_name(c)} by {number(errors[c]['before'], 2)} {unit_name(errors[c]['unit'])} "
        f"({_times(errors[c]['before'] / errors[c]['noise'])} the sensor's noise)"
        for c in out
    ]
    return f"Within {seconds(gain['horizon_s'])} the bare model misses {and_list(words)}."


def _times(ratio: float) -> str:
    return f"{ratio:.1f} times" if ratio < 20.0 else "far above"


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


LOADS = {
    "p": "rolling moment", "q": "pitching moment", "r": "yawing moment",
    "ax": "forward force", "ay": "sideways force", "az": "vertical force",
}  # fmt: skip
"""What is missing where a channel of findings.json's `unexplained` has a form."""


def _left(findings: Findings, vehicle: Vehicle) -> list[str]:
    described = [u for u in findings["unexplained"] if u["depends_on"]]
    rest = [u for u in findings["unexplained"] if not u["depends_on"]]
    lines = [
        f"A **{LOADS.get(u['channel'], channel_name(u['channel']))}** that follows "
        f"{and_list([channel_name(d) for d in u['depends_on']])}: {u['form']}. It is "
        f"{100 * u['share']:.0f} % of what moves the machine there beyond the model."
        for u in described
    ]
    if rest:
        shares = and_list([f"{channel_name(u['channel'])} {100 * u['share']:.0f} %" for u in rest])
        lines.append(
            "**Without a known form:** so much of what the model did not expect could have been "
            f"expected from its own past: {shares}. Of noise that would be none."
        )
    return [
        bullets(lines)
        if lines
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


# --- details --------------------------------------------------------------------------------------


def _details(result: "Diagnosis", command_line: str) -> list[str]:
    """How the search went, what the innovations look like, and how all of this was computed."""
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
        command(command_line) if command_line else "",
        details("How the search went", side_by_side(pair)) if pair else "",
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
        *_computed(result),
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


def _computed(result: "Diagnosis") -> list[str]:
    changed = changed_parameters(result.vehicle_before, result.vehicle_after)
    return [
        details(
            "How this was computed",
            prose(
                "One extended Kalman filter of the full model runs over each run. Every effect of the "
                "catalogue is moved a little, and its mark on the innovations is compared with what is "
                "left unexplained. The best is added, everything is fitted again, and causes already "
                "chosen are dropped or exchanged where that helps. Base parameters keep their priors. "
                "Causes and gain come from the runs that were not held out; the vehicle file is then "
                "fitted on all runs with the same structure."
            ),
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
