"""The study's arms in figures: one row per arm, with counts and Wilson intervals."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from coax_env.diagnosis.settings import SETTINGS
from study import judge
from study.arms import ARMS
from study.judge import OWN, Row
from study.plan import OUTSIDE
from study.table import cause_text, preamble

Test = Callable[[Row], bool]
Which = Callable[[Row, float], bool]
ALL = "all arms"
EFFECTS = ("one", "two", "three")

FIGURES: dict[str, tuple[str, tuple[str, ...], Which | None, Test]] = {
    "false_clean": (
        "a name on a clean flight", ("clean",), None, lambda row: bool(judge.named(row))),
    "false_clean_sure": (
        "the same, sure", ("clean",), None, lambda row: bool(judge.surely_named(row))),
    "exact_one": (
        "exact, one effect that should show", ("one",), judge.is_shown, judge.is_exact_row),
    "exact_one_likelier": (
        "exact, one effect that the likelihood shows", ("one",), judge.is_likelier,
        judge.is_exact_row),
    "exact_one_strict": (
        "the same, no ties counted", ("one",), judge.is_shown,
        lambda row: judge.is_strictly_exact(row)),
    "exact_one_all": ("exact, one effect", ("one",), None, judge.is_exact_row),
    "exact_more": (
        "exact, two or three effects that should show", ("two", "three"), judge.is_shown,
        judge.is_exact_row),
    "false_beside": (
        "anything false beside a true one", EFFECTS, None, lambda row: false_beside(row)),
    "false_beside_sure": (
        "the same, sure", EFFECTS, None,
        lambda row: bool(judge.false_names(row["hidden"], judge.surely_named(row)))),
    "blamed": (
        "a name for what is in no list", ("outside",), None, lambda row: bool(judge.named(row))),
    "blamed_sure": ("the same, sure", ("outside",), None, lambda row: bool(judge.surely_named(row))),
    "unexplained": (
        "in no list: unexplained, right axis, nothing blamed", ("outside",), None,
        lambda row: judge.reports_unexplained(row, OUTSIDE[row["hidden"][0]])),
}  # fmt: skip
"""Figure -> words, kinds of flights, which of them (None: all), what is counted."""


def false_beside(row: Row) -> bool:
    """Whether anything false is named on a flight with effects."""
    return bool(judge.false_names(row["hidden"], judge.named(row)))


def figures(rows: Sequence[Row]) -> dict[str, dict[str, list[int]]]:
    """Arm, and all of them -> figure -> [counted, of]; the last two figures are not of flights.

    "intervals": 95 % intervals that hold the truth, of true names on flights whose effects should all
    show. "sure_false": false ones among all sure names.
    """
    done = judge.finished(rows)
    arms = [arm for arm in ARMS if any(row["plan"]["arm"] == arm for row in done)]
    parts = {arm: [row for row in done if row["plan"]["arm"] == arm] for arm in arms}
    return {arm: _of_arm(part) for arm, part in {**parts, ALL: done}.items()}


def _of_arm(rows: Sequence[Row]) -> dict[str, list[int]]:
    result = {}
    for figure, (_, kinds, which, test) in FIGURES.items():
        part = [row for row in rows if row["plan"]["kind"] in kinds]
        if which:
            part = [row for row in part if which(row, SETTINGS.evidence)]
        result[figure] = [sum(map(test, part)), len(part)]
    shown = [r for r in rows if r["hidden"] and judge.is_shown(r, SETTINGS.evidence)]
    inside = [good for row in shown for _, good in judge.intervals(row)]
    result["intervals"] = [sum(inside), len(inside)]
    sure = [(row, name) for row in rows for name in judge.surely_named(row)]
    wrong = sum(bool(judge.false_names(row["hidden"], [name])) for row, name in sure)
    result["sure_false"] = [wrong, len(sure)]
    return result


WORDS = {figure: words for figure, (words, *_) in FIGURES.items()} | {
    "intervals": "95 % intervals that hold the truth",
    "sure_false": "sure names that are false",
}


def arm_text(rows: Sequence[Row], command: str) -> str:
    """arms.md."""
    parts = [f"# The arms\n\n`{command}`\n\n{preamble(rows)}\n\n", TIES_SAID]
    counted = figures(rows)
    for names in (NAMES, VALUES):
        heads = ["arm", *(WORDS[name] for name in names)]
        parts.append("\n" + " | ".join(["", *heads, ""]).strip() + "\n")
        parts.append("|---" * len(heads) + "|\n")
        for arm, figures_of_arm in counted.items():
            cells = [arm, *(_share(*figures_of_arm[name]) for name in names)]
            parts.append("| " + " | ".join(cells) + " |\n")
    parts.append("\n## What is named falsely\n\n" + _false_text(rows))
    failed = [row for row in rows if "error" in row]
    if failed:
        parts.append("\n## Flights that failed\n\n")
        parts += [f"- {_name(row)}: {row['error']}\n" for row in failed]
    return "".join(parts)


NAMES = (
    "false_clean",
    "false_clean_sure",
    "exact_one",
    "exact_one_likelier",
    "exact_one_strict",
    "exact_one_all",
    "exact_more",
)
VALUES = (
    "false_beside", "false_beside_sure", "blamed", "blamed_sure", "unexplained", "intervals",
    "sure_false",
)  # fmt: skip
TIES_SAID = (
    "Counts, shares and Wilson's 95 % intervals. Servo lag and servo delay count as one name, added"
    " mass and thrust scale as another, except where no ties are counted.\n"
)


def _share(good: int, count: int) -> str:
    if not count:
        return "-"
    low, high = judge.wilson(good, count)
    return f"{good}/{count} = {100 * good / count:.0f} % ({100 * low:.0f}-{100 * high:.0f})"


def _false_text(rows: Sequence[Row]) -> str:
    """Every false name, by arm: how often each, and on which flight."""
    parts = []
    for arm in ARMS:
        part = [r for r in judge.finished(rows) if r["plan"]["arm"] == arm]
        wrong = [(r, judge.false_names(r["hidden"], judge.named(r))) for r in part]
        wrong = [(row, names) for row, names in wrong if names]
        if not wrong:
            continue
        often = Counter(name for _, names in wrong for name in names)
        said = ", ".join(f"{name} {count}" for name, count in often.most_common())
        parts.append(f"**{arm}** ({len(part)} flights): {said}\n\n")
        parts += [_flight_text(row) for row, _ in wrong]
        parts.append("\n")
    return "".join(parts) or "Nothing.\n"


def _flight_text(row: Row) -> str:
    hidden = ", ".join(row["hidden"]) or "nothing"
    finding: dict[str, Any] = row["methods"][OWN]
    said = "; ".join(
        cause_text(cause) + (f", {cause['trust']}" if "trust" in cause else "")
        for cause in finding["causes"]
    )
    return f"- {_name(row)}, hidden {hidden}: {said} ({finding['verdict']})\n"


def _name(row: Row) -> str:
    plan = row["plan"]
    return f"{plan['arm']}-{plan['kind']}-{plan['number']:04d}"
