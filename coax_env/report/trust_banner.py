"""How far a diagnosis may be trusted, in a few lines at the top of its page."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from coax_env.plain_words import and_list, capital, count_word, error_change, plain, whole_percent
from coax_env.report.page import Markup, banner

if TYPE_CHECKING:
    from coax_env.diagnosis.diagnose import Diagnosis

Findings = Mapping[str, Any]


def trust_banner(result: "Diagnosis") -> Markup:
    """What speaks for and against a diagnosis: its names, its class, its gain, its noise, its data."""
    findings = result.findings
    kind, heading = how_far(findings)
    lines = [
        _names(findings["causes"]),
        false_alarms(findings["false_alarm_rate"], findings["class"]),
        _gain(findings["gain"]) if findings["causes"] else "",
        _model(findings["model_check"]["words"]),
        "The flights are **synthetic**: a simulator flew them." if result.flight.synthetic else "",
        *(f"{capital(r)}." for r in result.remarks if r.startswith("check ")),
    ]
    return banner(heading, [line for line in lines if line], kind)


def how_far(findings: Findings) -> tuple[str, str]:
    """How a diagnosis may be used: kind of the banner, and its heading.

    Args:
        findings: as in findings.json.
    """
    causes, gain = findings["causes"], findings["gain"]
    sure = [c for c in causes if c["trust"] == "sure"]
    if not causes and findings["verdict"] == "consistent":
        return "good", "How far to trust this: the model may be used as it is"
    if not sure:
        return "warning", "How far to trust this: take no name from these flights"
    by_chance = gain and gain["ci95"][0] is not None and gain["ci95"][0] <= 0.0
    if by_chance:
        return "warning", "How far to trust this: the gain may be chance"
    left = len(sure) < len(causes) or findings["unexplained"] or findings["model_check"]["words"]
    if left:
        return "note", "How far to trust this: the sure names, not yet the whole model"
    return "good", "How far to trust this: the names and the model"


def _names(causes: Sequence[Mapping[str, Any]]) -> str:
    """Which names are sure, and which are doubtful."""
    groups = {
        trust: [plain(c["effect"]) for c in causes if c["trust"] == trust]
        for trust in ("sure", "doubtful")
    }
    said = [f"{capital(trust)}: {and_list(names)}." for trust, names in groups.items() if names]
    if groups["doubtful"]:
        said.append("A doubtful name stands for something that improves the prediction.")
    return " ".join(said)


def false_alarms(rate: float | None, seen: Mapping[str, Any]) -> str:
    """How often a cause is named where there is none, in flights of this class.

    Args:
        rate: findings.json's ``false_alarm_rate``. seen: its ``class``.
    """
    if rate is None:
        return (
            "**False alarms.** How often a cause is named where there is none is not known for flights "
            f"of this class ({seen['why']})."
        )
    return (
        f"**False alarms.** The threshold is calibrated on {seen['calibrated']} without any effect: a "
        f"cause is named in {100 * rate:.2g} % of them."
    )


def _gain(gain: Mapping[str, Any] | None) -> str:
    """Whether the corrected model also predicts flights that it was not fitted to."""
    if not gain or gain["error_removed_percent"] is None:
        return "**Gain.** Not measured: nothing was held out that could be flown."
    removed, nothing = gain["error_removed_percent"], gain["persistence_percent"]
    low, high = gain["ci95"]
    text = f"**Gain.** On runs that it has not seen {error_change(removed)}"
    text += f" ({low:.0f} to {high:.0f})." if low is not None else "."
    if low is not None and low <= 0.0:
        text += " The interval holds zero."
    if nothing is not None and nothing > removed:
        text += f" To say that nothing moves removes {whole_percent(nothing)}: more."
    return text.replace("-", "−")


def _model(words: Sequence[str]) -> str:
    """Whether the fitted model, flown with its own noise, makes such flights."""
    if not words:
        return (
            "**Noise.** Flown with the fitted noise, the corrected model makes flights like these."
        )
    places = "one respect" if len(words) == 1 else f"{count_word(len(words))} respects"
    return f"**Noise.** The corrected model does not make such flights in {places}: see below."
