"""The report of a diagnosis: what the simulation gets wrong, why, and what correcting it gains.

One page for someone who was not there: two minutes to read, the details folded away at its end.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from coax_env.estimation.trajectories import RESTART, trajectories
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import (
    and_list,
    capital,
    channel_name,
    count_word,
    error_change,
    number,
    plain,
    seconds,
)
from coax_env.report.causes import cause_sections, confounding_blocks, since
from coax_env.report.diagnosis_details import detail_blocks
from coax_env.report.flight_data import data_blocks, ordered
from coax_env.report.flight_view import flight_view
from coax_env.report.gain import ControllerScores, controller_blocks, gain_blocks, gain_tiles
from coax_env.report.page import Section, bullets, callout, details, page, prose
from coax_env.report.plot_style import AFTER, BEFORE
from coax_env.report.prediction_errors import error_blocks
from coax_env.report.trust_banner import trust_banner

if TYPE_CHECKING:
    from coax_env.diagnosis.diagnose import Diagnosis

Findings = Mapping[str, Any]
MOST_CAUSES_NAMED = 4
"""Causes in the headline; of more, the strongest three."""
MOST_RUNS_NAMED = 12  # of more, their number


def diagnosis_page(
    result: "Diagnosis", command_line: str = "", controllers: ControllerScores | None = None
) -> str:
    """The report of one diagnosis as HTML text.

    Args:
        result: of `coax_env.diagnose`.
        command_line: what was typed.
        controllers: of both models, where they were flown.
    """
    findings, bare, corrected = result.findings, result.vehicle_before, result.vehicle_after
    sections = [
        Section("The flights", _flights(result)),
        Section("Where the bare model is wrong", error_blocks(result)),
        *cause_sections(findings, bare, corrected, result.remarks),
        Section("Confounded alternatives", confounding_blocks(findings)),
        Section("What the corrected model gains", gain_blocks(findings)),
        Section("Still unexplained", _unexplained(findings, bare)),
        Section(
            "Controllers of both models", controller_blocks(controllers) if controllers else []
        ),
        Section("Details", detail_blocks(result, command_line)),
    ]
    flight = result.flight.path.name if result.flight.path else "without a folder"
    kind = "synthetic flight" if result.flight.synthetic else "flight"
    return page(
        headline(findings),
        lead(findings),
        [section for section in sections if any(section.blocks)],
        kicker=f"Diagnosis · {kind} {flight} · vehicle {bare.name}",
        top=(gain_tiles(findings) if findings["verdict"] != "consistent" else "")
        + trust_banner(result),
    )


def headline(findings: Findings) -> str:
    """The verdict in one sentence."""
    names = [plain(c["effect"]) for c in findings["causes"]]
    sure = [plain(c["effect"]) for c in findings["causes"] if c["trust"] == "sure"]
    doubtful = [plain(c["effect"]) for c in findings["causes"] if c["trust"] != "sure"]
    verb = "explains" if len(names) == 1 else "explain"
    if sure and doubtful and len(names) > MOST_CAUSES_NAMED:
        named = and_list([*sure, f"{count_word(len(doubtful))} doubtful effects"])
    elif sure and doubtful:
        named = f"{and_list(sure)} and, doubtful, {and_list(doubtful)}"
    elif len(names) > MOST_CAUSES_NAMED:
        named = f"{count_word(len(names))} effects, above all {and_list(names[:3])},"
    else:
        named = and_list(names) if names else ""
    if findings["verdict"] == "consistent":
        return "The simulation agrees with these flights"
    if names and not sure:
        said = "the name is doubtful" if len(names) == 1 else "the names are doubtful"
        return f"The model predicts better with {named.rstrip(',')}; {said}"
    if findings["verdict"] == "explained":
        return f"{capital(named)} {verb} what the simulation got wrong"
    if findings["verdict"] == "partly explained":
        return f"{capital(named)} {verb} a part of what the simulation got wrong"
    return "The simulation misses something that no known effect explains"


def lead(findings: Findings) -> list[str]:
    """The result in a few sentences."""
    sentences = [
        f"{capital(plain(c['effect']))} {'changed' if c['before'] else 'is there'}, {since(c)}."
        for c in findings["causes"]
        if c.get("since")
    ]
    gain = findings.get("gain")
    if findings["verdict"] == "consistent":
        sentences.append("The residual is sensor noise and gusts: no effect is worth adding.")
    if gain and findings["causes"]:
        error = f"the error of a {seconds(gain['horizon_s'])} prediction"
        change = error_change(gain["error_removed_percent"], error, "**")
        runs = and_list(list(gain["held_out"]))
        which = "it" if len(findings["causes"]) == 1 else "them"
        sentences.append(
            f"With {which} in the model, {change} on runs held out of the fit ({runs})."
        )
    elif not gain:
        unknown = "how well this predicts is not known"
        sentences.append(f"Nothing was held out that could be flown, so {unknown}.")
    alternatives = sorted({name for c in findings["causes"] for name in c["confusable_with"]})
    if alternatives:
        sentences.append(
            "These flights cannot distinguish every effect: "
            f"{and_list([plain(name) for name in alternatives])} could stand in for a cause named "
            "here."
        )
    if findings["unexplained"]:
        where = list(dict.fromkeys(channel_name(u["channel"]) for u in findings["unexplained"]))
        sentences.append(f"Unexplained structure is left in {and_list(where)}.")
    return sentences


# --- the flights ----------------------------------------------------------------------------------


def _flights(result: "Diagnosis") -> list[str]:
    """The flights in a sentence, and to be looked at."""
    flight, bare, corrected = result.flight, result.vehicle_before, result.vehicle_after
    models = {"bare": bare}
    if corrected.effects != bare.effects:
        models["corrected"] = corrected
    paths = trajectories(flight, corrected, models)
    paths.sort(key=lambda path: -float(path.error_removed().max()))
    source = (
        "as measured"
        if "pn" in flight.channels
        else "as estimated from the readings: no sensor measures it"
    )
    begun = any(c.get("since") for c in result.findings["causes"])
    later = " The corrected model is the machine as it is last: before a cause began, it is not."
    view = flight_view(
        paths,
        dict(zip(models, (BEFORE, AFTER), strict=False)),
        bare["rotor_radius"].value,
        {run.name for run in result.replay_before},
        f"Grey: the machine, its position {source}. Every {seconds(RESTART)} the simulations are "
        "set to it; from there they fly with the recorded commands, and the curves show how far "
        f"off they get.{later if begun else ''}",
    )
    sensors = and_list([channel_name(c) for c in ordered(flight.channels)])
    data = data_blocks(flight, result.remarks, result.noise)
    return [
        prose(_runs_in_words(result)),
        view,
        details("The runs and sensors", prose(f"Measured: {sensors}."), *data),
    ]


def _runs_in_words(result: "Diagnosis") -> str:
    flight = result.flight
    total = sum(run.duration for run in flight.runs)
    names = list(flight.run_names[:MOST_RUNS_NAMED])
    if len(flight.runs) > MOST_RUNS_NAMED:
        names.append(f"{len(flight.runs) - MOST_RUNS_NAMED} more")
    count = f"{capital(count_word(len(flight.runs)))} run" + ("s" if len(flight.runs) > 1 else "")
    return f"{count} of a {result.vehicle_before.name}, {total:.0f} s in all: {and_list(names)}."


# --- the residual ---------------------------------------------------------------------------------


LOADS = {
    "p": "rolling moment", "q": "pitching moment", "r": "yawing moment",
    "ax": "forward force", "ay": "sideways force", "az": "vertical force",
}  # fmt: skip
"""What is missing where a channel of findings.json's `unexplained` has a form."""


def _unexplained(findings: Findings, vehicle: Vehicle) -> list[str]:
    """Structure beyond the causes, what the fitted model does not make, and the gusts."""
    with_form = [u for u in findings["unexplained"] if u["depends_on"]]
    unnamed = [u for u in findings["unexplained"] if "like" in u]
    without = [u for u in findings["unexplained"] if not u["depends_on"] and "like" not in u]
    lines = [
        f"A **{LOADS.get(u['channel'], channel_name(u['channel']))}** that follows "
        f"{and_list([channel_name(d) for d in u['depends_on']])}: {u['form']}. It is "
        f"{100 * u['share']:.0f} % of what the model leaves there."
        for u in with_form
    ]
    lines += [
        f"In **{channel_name(u['channel'])}** something goes **{u['form']}**, worth "
        f"{number(u['evidence'])} nats. The model has it, but it has no name: {'; '.join(u['why'])}."
        for u in unnamed
    ]
    if without:
        shares = and_list(
            [f"{channel_name(u['channel'])} {100 * u['share']:.0f} %" for u in without]
        )
        lines.append(
            "**Without a known form:** the share of the innovations' variance that their own past "
            f"predicts: {shares}. Of white noise it is 0."
        )
    return [
        bullets(lines)
        if lines
        else callout("The innovations are white: nothing but noise and gusts is left.", "good"),
        bullets(f"{capital(words)}." for words in findings["model_check"]["words"]),
        prose(_gusts_in_words(findings["gusts"], vehicle)),
    ]


def _gusts_in_words(gusts: Mapping[str, Any], vehicle: Vehicle) -> str:
    force = ", ".join(number(1000 * f, 2) for f in gusts["force_N"])
    moment = ", ".join(number(1000 * m, 2) for m in gusts["moment_Nm"])
    largest = max(gusts["force_N"]) / vehicle["mass"].value
    return (
        f"**Gusts.** Forces of {force} mN and moments of {moment} mN m (std; x, y, z), "
        f"correlated over {number(gusts['memory_s'], 2)} s: at most {number(largest, 2)} m/s² of "
        "acceleration. They are estimated with the causes, as noise, and are never a cause."
    )
