"""The study in figures: every row of the bar's table, measured, with counts and intervals."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.diagnosis.settings import SETTINGS
from coax_env.model.effects import CATALOGUE
from coax_env.report import figures
from study import judge
from study.judge import OWN, Row
from study.plan import OUTSIDE

LEAST_GAIN = 5.0  # % that the true structure removes; below it there is no share to speak of


@dataclass(frozen=True)
class Figure:
    """One row of the table: `good` of `count`, or a `value` in percent of its own.

    apart: what is listed apart, in words.
    """

    name: str
    bar: str
    good: float
    count: int
    value: float | None = None
    apart: str = ""

    def as_json(self) -> dict[str, Any]:
        """For summary.json."""
        low, high = (None, None)
        if self.value is None and self.count:
            low, high = (100.0 * x for x in judge.wilson(int(self.good), self.count))
        return {
            "figure": self.name, "bar": self.bar, "percent": self.percent, "good": self.good,
            "count": self.count, "wilson95": [low, high] if low is not None else None,
            "apart": self.apart,
        }  # fmt: skip

    @property
    def percent(self) -> float | None:
        """The measured figure."""
        if not self.count:
            return None
        return 100.0 * self.good / self.count if self.value is None else self.value


def all_figures(rows: Sequence[Row], method: str = OWN) -> list[Figure]:
    """The bar's table for one method. Only the package's own has intervals, gains and axes."""
    rows = [row for row in judge.finished(rows) if method in row["methods"]]
    result = _names(rows, method)
    if method == OWN:
        result += [_outside(rows), *_coverage(rows), _gain(rows)]
    else:
        result.append(_visible(rows, method))
    result += _hover(rows, method)
    return result


def _of(rows: Iterable[Row], *kinds: str) -> list[Row]:
    return [row for row in rows if row["plan"]["kind"] in kinds]


def _share(
    name: str, bar: str, rows: Sequence[Row], good: Callable[[Row], bool], apart: str = ""
) -> Figure:
    return Figure(name, bar, sum(good(row) for row in rows), len(rows), apart=apart)


def _names(rows: Sequence[Row], method: str) -> list[Figure]:
    """Which names were given: clean flights, one, two and three effects."""

    def alarmed(row: Row) -> bool:
        return bool(judge.named(row, method))

    def exact(row: Row) -> bool:
        return judge.is_exact_row(row, method)

    result = []
    clean = _of(rows, "still", "gusty")
    result.append(_share("false alarms, clean flights", "<= 2 %", clean, alarmed))
    for kind in ("still", "gusty"):
        for sensors in ("full", "onboard"):
            part = [r for r in _of(rows, kind) if r["plan"]["sensors"] == sensors]
            result.append(_share(f"false alarms, {kind}, {sensors} sensors", "", part, alarmed))
    shown, faint = _split(_of(rows, "one"))
    apart = f"{sum(map(exact, faint))} of {len(faint)} exact where less was to be expected"
    result.append(_share("exact cause, one effect", ">= 95 %", shown, exact, apart))
    result.append(
        _share(
            "truth in the group, at most 2 names", ">= 98 %", shown,
            lambda row: 1 <= judge.group_with_truth(row, method) <= 2,
        )
    )  # fmt: skip
    result.append(
        _share(
            "something false named, one effect", "", _of(rows, "one"),
            lambda row: _anything_false(row, method),
        )
    )  # fmt: skip
    for kind, bar in (("two", ">= 80 %"), ("three", ">= 60 %"), ("many", "")):
        if kind == "many" and not _of(rows, kind):
            continue
        shown, faint = _split(_of(rows, kind))
        apart = f"{sum(map(exact, faint))} of {len(faint)} exact where one was not expected to show"
        result.append(_share(f"exact set, {kind} effects", bar, shown, exact, apart))
    return result


def _split(rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    """Rows whose effects were all expected to show, and the others."""
    shown = [row for row in rows if judge.is_shown(row, SETTINGS.evidence)]
    return shown, [row for row in rows if not judge.is_shown(row, SETTINGS.evidence)]


def _anything_false(row: Row, method: str) -> bool:
    return bool(judge.false_names(row["hidden"], judge.named(row, method)))


def _outside(rows: Sequence[Row]) -> Figure:
    part = _of(rows, "outside")
    unblamed = sum(not judge.named(row) for row in part)
    return _share(
        "outside the list: unexplained, right axis", ">= 80 %", part,
        lambda row: judge.reports_unexplained(row, OUTSIDE[row["hidden"][0]]),
        f"no effect blamed in {unblamed} of {len(part)}",
    )  # fmt: skip


def _coverage(rows: Sequence[Row]) -> list[Figure]:
    """95 % intervals that hold the truth, by weather; the parameters that ever miss are named.

    Where every hidden effect was expected to show: one that is there unseen is in the others' numbers.
    """
    result = []
    shown, faint = _split(rows)
    for gusts, bar, words in ((True, "93-97 %", "in gusts"), (False, "", "in still air")):
        by_name: dict[str, list[bool]] = {}
        for row in shown:
            if row["plan"]["gusts"] == gusts:
                for name, inside in judge.intervals(row):
                    by_name.setdefault(name, []).append(inside)
        beside = [
            inside
            for row in faint
            if row["plan"]["gusts"] == gusts
            for _, inside in judge.intervals(row)
        ]
        every = [inside for part in by_name.values() for inside in part]
        worst = sorted(by_name.items(), key=lambda item: float(np.mean(item[1])))
        missed = ", ".join(f"{n} {sum(part)}/{len(part)}" for n, part in worst if not all(part))
        name = f"95 % intervals that cover, {words}"
        apart = f"{sum(beside)} of {len(beside)} beside an effect that was not expected to show"
        result.append(
            Figure(
                name, bar, sum(every), len(every), apart="; ".join(filter(None, [missed, apart]))
            )
        )
    return result


def _gain(rows: Sequence[Row]) -> Figure:
    """Error removed by what was found, as a share of what the true structure refitted removes."""
    pairs = []
    for row in rows:
        truth = (row.get("true_structure") or {}).get("error_removed_percent")
        own = (row["gain"] or {}).get("error_removed_percent")
        if truth is not None and own is not None and truth >= LEAST_GAIN:
            pairs.append((own, truth))
    value = 100.0 * sum(p[0] for p in pairs) / sum(p[1] for p in pairs) if pairs else 0.0
    reached = sum(own >= 0.9 * truth for own, truth in pairs)
    return Figure(
        "held-out error removed, share of the truth's", ">= 90 %", reached, len(pairs),
        value,
        f"{reached} of {len(pairs)} flights reach 90 % themselves",
    )  # fmt: skip


def _visible(rows: Sequence[Row], method: str) -> Figure:
    """The baselines see forces and moments only; their fair share is this."""
    shown, _ = _split(_of(rows, "one"))
    part = [row for row in shown if set(row["hidden"]) <= set(row["methods"][method]["visible"])]
    return _share(
        "exact cause, one effect that acts on forces or moments", "", part,
        lambda row: judge.is_exact_row(row, method),
    )  # fmt: skip


def _hover(rows: Sequence[Row], method: str) -> list[Figure]:
    part = _of(rows, "hover")
    shown, faint = _split(part)

    def held(row: Row) -> bool:
        return judge.group_with_truth(row, method) > 0

    apart = f"{sum(map(held, faint))} of {len(faint)} where less was to be expected"
    return [
        _share(
            "hover only: wrongly certain", "<= 5 %", part,
            lambda row: judge.is_wrongly_certain(row, method),
        ),
        _share("hover only: truth in the reported group", ">= 80 %", shown, held, apart),
    ]  # fmt: skip


# --- the confusion matrix -------------------------------------------------------------------------


def confusion(rows: Iterable[Row]) -> tuple[list[str], list[str], np.ndarray]:
    """Truth against names, flights with one effect: (true names, names given, shares per row).

    A flight on which several effects are named counts as a fraction in each.
    """
    part = _of(judge.finished(rows), "one")
    names = [*CATALOGUE, *sorted({r["hidden"][0] for r in part} - set(CATALOGUE))]
    truths = [name for name in names if any(row["hidden"][0] == name for row in part)]
    columns = [*CATALOGUE, "nothing"]
    counts = np.zeros((len(truths), len(columns)))
    for row in part:
        found = judge.named(row) or ["nothing"]
        for name in found:
            counts[truths.index(row["hidden"][0]), columns.index(name)] += 1.0 / len(found)
    used = np.asarray(counts.any(axis=0))
    totals = counts.sum(axis=1, keepdims=True)
    shares = counts / np.maximum(totals, 1.0)
    return truths, [c for c, u in zip(columns, used.tolist(), strict=True) if u], shares[:, used]


def confusion_figure(truths: list[str], names: list[str], shares: np.ndarray) -> figures.Figure:
    """The matrix as colours.

    Args:
        truths: names of its rows.
        names: of its columns.
        shares: (truths, names), each row's sum 1.
    """
    text = [[f"{100.0 * s:.0f}" if s > 0.0 else "" for s in row] for row in shares]
    return figures.heat_map(truths, names, shares, text, "share of flights")


def confusion_csv(truths: list[str], names: list[str], shares: np.ndarray) -> str:
    """The matrix as a CSV.

    Args:
        truths: names of its rows.
        names: of its columns.
        shares: (truths, names), each row's sum 1.
    """
    lines = [",".join(["hidden", *names])]
    for truth, row in zip(truths, shares, strict=True):
        lines.append(",".join([truth, *(f"{share:.3f}" for share in row)]))
    return "\n".join(lines) + "\n"


# --- words ----------------------------------------------------------------------------------------


def table_text(rows: Sequence[Row], command: str) -> str:
    """table.md."""
    done = judge.finished(rows)
    parts = [f"# Study of the diagnosis\n\n`{command}`\n\n{preamble(rows)}\n"]
    methods = sorted({m for row in done for m in row["methods"]}, key=lambda m: (m != OWN, m))
    for method in methods:
        title = "This package" if method == OWN else f"Baseline: {method}"
        parts.append(f"\n## {title}\n\n{_markdown(all_figures(done, method))}\n")
    if done and "STLSQ" not in methods:
        parts.append(
            "\nNo sparse regression: PySINDy is not installed (`pip install 'coaxheli[study]'`).\n"
        )
    parts.append(f"\n## Not exact, one effect that should show\n\n{_misses(done)}\n")
    parts.append(f"\n## Alarms on clean flights\n\n{_alarms(done)}\n")
    failed = [row for row in rows if "error" in row]
    if failed:
        parts.append("\n## Flights that failed\n\n")
        parts += [f"- {_name(row)}: {row['error']}\n" for row in failed]
    return "".join(parts)


def preamble(rows: Sequence[Row]) -> str:
    """How many flights, of which code, and how long they took."""
    done = judge.finished(rows)
    codes = sorted({row["code"] for row in rows})
    text = f"{len(done)} flights, {len(rows) - len(done)} failed; code {', '.join(codes)}."
    if len(codes) > 1:
        text += " Made by several versions of the code: not one study."
    rich = [row["seconds"] for row in done if row["plan"]["kind"] != "hover"]
    if rich:
        flown = np.median([row["flown_s"] for row in done if row["plan"]["kind"] != "hover"])
        text += (
            f" Diagnosis of a flight of {flown:.0f} s on one thread: median"
            f" {np.median(rich):.0f} s, longest {max(rich):.0f} s."
        )
    return text


def _markdown(rows: Sequence[Figure]) -> str:
    lines = ["| figure | bar | measured | of | 95 % interval | |", "|---|---|---|---|---|---|"]
    for row in rows:
        measured, interval = "-", "-"
        if row.count:
            measured = f"{row.percent:.1f} %"
            if row.value is None:
                low, high = judge.wilson(int(row.good), row.count)
                interval = f"{100 * low:.1f}-{100 * high:.1f} %"
        counted = f"{row.good:g}/{row.count}" if row.value is None else f"{row.count}"
        lines.append(
            f"| {row.name} | {row.bar} | {measured} | {counted} | {interval} | {row.apart} |"
        )
    return "\n".join(lines)


def _misses(rows: Sequence[Row]) -> str:
    shown, _ = _split(_of(rows, "one"))
    lines = []
    for row in shown:
        if not judge.is_exact_row(row):
            values = ", ".join(f"{n} = {v:.3g}" for n, v in row["values"].items())
            expected = row["expected"][row["hidden"][0]]
            found = (
                "; ".join(cause_text(cause) for cause in row["methods"][OWN]["causes"]) or "nothing"
            )
            lines.append(f"- {_name(row)}: {values} (expected {expected:.0f} nats): {found}")
    return "\n".join(lines) or "None."


def _alarms(rows: Sequence[Row]) -> str:
    lines = []
    for row in _of(rows, "still", "gusty"):
        if judge.named(row):
            found = "; ".join(cause_text(cause) for cause in row["methods"][OWN]["causes"])
            lines.append(f"- {_name(row)} ({row['plan']['sensors']}): {found}")
    return "\n".join(lines) or "None."


def cause_text(cause: dict[str, Any]) -> str:
    """A cause in words."""
    alike = ", ".join(cause["confusable_with"])
    return f"{cause['effect']} {cause['evidence']:.0f} nats" + (f" (or {alike})" if alike else "")


def _name(row: Row) -> str:
    return f"{row['plan']['kind']}-{row['plan']['number']:04d}"
