"""Changes of a card's [columns] that would bring a log to agree with itself: tried, not guessed.

Every change that a card can say - another sign, another unit, two columns taken for each other, other
frames - is made to the signals, and all checks are asked again. What leaves the fewest
faults, and of these the least disagreement, is the advice; where two do equally, both are.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from coax_env.consistency.checks import (
    FAULT_COUNTS,
    PAIRS,
    Checker,
    Fault,
    Found,
    Signals,
    swapped,
    swapped_names,
)
from coax_env.logs.card_columns import Column
from coax_env.logs.flight import Flight
from coax_env.logs.units import LOG_UNITS, units_of

Columns = Mapping[str, Column]

MOST_CHANGES = 8
"""Lines of a card that are looked for; ours."""
SAME = 6.0
"""Difference of badness up to which two changes do equally; ours."""
SOLVED = FAULT_COUNTS
"""Badness below which a change has solved it: nothing that spoke against the log has only fallen
silent."""
MOST_ALTERNATIVES = 3
STEP_COST = 2.0
"""Badness that a change of more than one line costs a line; ours."""

SWAPPED = (
    *PAIRS,
    ("vn", "ve", "pn", "pe"), ("rpm_upper_cmd", "rpm_lower_cmd", "rpm_upper", "rpm_lower"),
    ("p", "q", "phi", "theta"),
)  # fmt: skip
"""Columns taken for each other: the first for the second, the third for the fourth."""
TURNED = (
    ("phi", "p"), ("theta", "q"), ("psi", "r"), ("h", "vd"), ("vn", "pn"), ("ve", "pe"),
    ("phi", "p", "delta_lat"), ("theta", "q", "delta_lon"), ("ay", "az"), ("q", "r"),
    ("theta", "psi"), ("q", "r", "ay", "az"), ("q", "r", "ay", "az", "theta", "psi"),
)  # fmt: skip
"""Axes that are turned together: x forward, y left, z up in place of ours, or rates and their
angles."""
SAME_UNIT = (
    ("p", "q", "r"), ("phi", "theta", "psi"), ("phi", "theta"), ("ax", "ay", "az"),
    ("vn", "ve", "vd"), ("vn", "ve"), ("pn", "pe"), ("pn", "pe", "h"),
    ("delta_lon", "delta_lat"), ("rpm_upper_cmd", "rpm_lower_cmd"), ("rpm_upper", "rpm_lower"),
    ("rpm_upper_cmd", "rpm_lower_cmd", "rpm_upper", "rpm_lower"),
)  # fmt: skip
"""Columns whose unit is usually wrong together."""
IN_DEGREES = ("phi", "theta", "psi", "p", "q", "r")
SCALES = (57.29578, 0.01745329, 9.80665, 0.1019716, 1000.0, 0.001, 100.0, 0.01)
"""Factors that are tried where no unit is one: a column that its writer had in another unit already."""
SELDOM = ("mrad", "mrad/s", "km", "km/s", "ft/min", "rev", "deg/s", "km/s2", "in/s2", "in/s", "mg")
"""Units that are tried too, and cost as much as a second line."""


@dataclass(frozen=True)
class Change:
    """A change of one or more columns of a card.

    apply: what it does to a run's signals. line: what it does to the columns.
    """

    channels: frozenset[str]
    apply: Callable[[Signals], Signals]
    line: Callable[[dict[str, Column]], dict[str, Column]]
    cost: float = 0.0
    seldom: bool = False
    """Tried only where no other change solves it."""


@dataclass(frozen=True)
class Advice:
    """Lines of a card that would put the faults right; `alternatives`: others that would do as well."""

    lines: tuple[str, ...]
    alternatives: tuple[tuple[str, ...], ...]
    left: tuple[Fault, ...]


def advice(flight: Flight, checker: Checker, found: Found) -> Advice:
    """The change of a flight's card that its faults ask for.

    Args:
        flight: as read.
        checker: of it.
        found: what the checks say of it.
    """
    columns = {c: flight.columns.get(c, Column.own(c)) for c in checker.channels if c in LOG_UNITS}
    original = dict(columns)
    changed: dict[str, Column] = {}
    done: list[Change] = []
    others: list[tuple[str, ...]] = []
    while found.faults and len(done) < MOST_CHANGES:
        tried = _tried(columns, checker, found, done)
        if not tried:
            break
        best, after, bad = tried[0]
        if found.badness - bad <= SAME:
            break
        others.append(_others(tried, columns) if not done else ())
        done.append(best)
        new = best.line(columns)
        changed |= {c: new[c] for c in sorted(best.channels)}
        columns, found = {**columns, **changed}, after
    if done and not found.faults:
        done, found = _turned(original, checker, done)
        columns = _all_lines(done, original)
        changed = {c: columns[c] for one in done for c in sorted(one.channels)}
    lines = tuple(columns[c].entry(c) for c in changed)
    alternatives = tuple(o for o in others if o) if len(done) == 1 else ()
    return Advice(lines, alternatives, found.faults)


def _turned(
    columns: dict[str, Column], checker: Checker, done: list[Change]
) -> tuple[list[Change], Found]:
    """The changes, with another heading where north and east would still be taken for each other.

    A heading that is counted from another axis swaps them, and no single other change shows that.
    """
    found = checker.after(partial(_all_applied, done), _channels_of(done), swaps=True)
    others = [one for one in done if one.channels != {"psi"}]
    if found.faults and "psi" in columns:
        results = []
        for heading in _headings():
            both = [*others, heading]
            after = checker.after(partial(_all_applied, both), _channels_of(both), swaps=True)
            results.append((after.badness, both, after))
        _, both, after = min(results, key=lambda one: one[0])
        if not after.faults:
            return both, after
    return done, found


def _all_lines(changes: Sequence[Change], columns: dict[str, Column]) -> dict[str, Column]:
    for change in changes:
        columns = change.line(columns)
    return columns


def _tried(
    columns: dict[str, Column], checker: Checker, found: Found, done: Sequence[Change]
) -> list[tuple[Change, Found, float]]:
    """Every change beside those that are done, the best first: with what the checks say then, and
    how bad.

    A fault that has only fallen silent is none the better.
    """
    suspects = _channels_of(found.faults)
    failed = {fault.check for fault in found.faults}
    spoke = {c.check: c.share for c in found.coefficients if c.check in failed}
    results: list[tuple[Change, Found, float]] = []
    for change in [*_usual_changes(columns), *_seldom_changes(columns)]:
        if not change.channels & suspects:
            continue
        if change.seldom and any(not after.faults and bad < SOLVED for _, after, bad in results):
            break
        both = (*done, change)
        after = checker.after(partial(_all_applied, both), _channels_of(both))
        bad = after.badness + FAULT_COUNTS * after.silenced(spoke) + change.cost
        results.append((change, after, bad))
    results.sort(key=lambda one: one[2])
    return results


def _all_applied(changes: Sequence[Change], signals: Signals) -> Signals:
    for change in changes:
        signals = change.apply(signals)
    return signals


def _channels_of(of: Sequence[Change] | Sequence[Fault]) -> frozenset[str]:
    return frozenset(channel for one in of for channel in one.channels)


def _others(
    tried: Sequence[tuple[Change, Found, float]], columns: dict[str, Column]
) -> tuple[str, ...]:
    """Other changes of other channels that do as well as the best."""
    best, _, least = tried[0]
    seen = {best.channels}
    lines = []
    for change, _, bad in tried[1:]:
        if bad - least <= SAME and change.channels not in seen:
            seen.add(change.channels)
            new = change.line(columns)
            lines.append(", ".join(new[c].entry(c) for c in sorted(change.channels)))
    return tuple(lines[:MOST_ALTERNATIVES])


# --- the changes ----------------------------------------------------------------------------------


def _usual_changes(columns: Columns) -> list[Change]:
    """A sign or a unit, of one column or of several that go together."""
    single = [(c,) for c in sorted(columns)]
    found = [_flip(g) for g in (*single, *TURNED) if set(g) <= columns.keys()]
    for group in (*single, *SAME_UNIT):
        if set(group) <= columns.keys():
            found += _units(group, columns)
    if set(IN_DEGREES) <= columns.keys() and all(columns[c].factor == 1.0 for c in IN_DEGREES):
        found.append(_degrees())
    return found


def _degrees() -> Change:
    """Attitude and gyros in degrees, all of them: apart, each would only disagree with the other."""
    parts = [
        _unit(IN_DEGREES[:3], "deg", np.pi / 180.0, np.pi / 180.0),
        _unit(IN_DEGREES[3:], "deg/s", np.pi / 180.0, np.pi / 180.0),
    ]
    return Change(
        frozenset(IN_DEGREES),
        partial(_all_applied, parts),
        lambda columns: parts[1].line(parts[0].line(columns)),
        STEP_COST,
    )


def _seldom_changes(columns: Columns) -> list[Change]:
    """Columns taken for each other, other headings, and factors that are no unit."""
    found = [_swap(names) for names in SWAPPED if set(names) <= columns.keys()]
    if "psi" in columns:
        found += _headings()
    found += [_scale(c, ratio) for c in sorted(columns) for ratio in SCALES]
    return found


def _headings() -> list[Change]:
    """From another axis, or counted the other way round."""
    turns = ((1, np.pi), (1, np.pi / 2), (1, -np.pi / 2), (-1, np.pi / 2), (-1, -np.pi / 2))
    return [_heading(sign, turn) for sign, turn in turns]


def _plain(column: Column, channel: str) -> str:
    """The unit's name in the table, by its factor."""
    return min(units_of(channel), key=lambda unit: abs(units_of(channel)[unit] - column.factor))


def _flip(channels: Sequence[str]) -> Change:
    def line(columns: dict[str, Column]) -> dict[str, Column]:
        return {**columns, **{c: replace(columns[c], sign=-columns[c].sign) for c in channels}}

    return Change(
        frozenset(channels),
        lambda s: {**s, **{c: -s[c] for c in channels if c in s}},
        line,
        STEP_COST * (len(channels) - 1),
    )


def _units(channels: Sequence[str], columns: Columns) -> list[Change]:
    """Every other unit that columns of one unit may have."""
    first = channels[0]
    current = units_of(first)[_plain(columns[first], first)]
    seen = [1.0]
    found = []
    for unit, factor in units_of(first).items():
        ratio = factor / current
        if not any(abs(ratio / other - 1.0) < 1e-6 for other in seen):
            seen.append(ratio)
            found.append(_unit(channels, unit, factor, ratio))
    return found


def _scale(channel: str, ratio: float) -> Change:
    def line(columns: dict[str, Column]) -> dict[str, Column]:
        new = replace(columns[channel], scale=ratio * columns[channel].scale)
        return {**columns, channel: new}

    return Change(
        frozenset([channel]),
        lambda s: {**s, channel: ratio * s[channel]} if channel in s else s,
        line,
        2.0 * STEP_COST,
        seldom=True,
    )


def _unit(channels: Sequence[str], unit: str, factor: float, ratio: float) -> Change:
    def line(columns: dict[str, Column]) -> dict[str, Column]:
        changed = {c: replace(columns[c], unit=unit, factor=factor) for c in channels}
        return {**columns, **changed}

    return Change(
        frozenset(channels),
        lambda s: {**s, **{c: ratio * s[c] for c in channels if c in s}},
        line,
        STEP_COST * (len(channels) - 1 + (unit in SELDOM)),
    )


def _swap(names: Sequence[str]) -> Change:
    def line(columns: dict[str, Column]) -> dict[str, Column]:
        other = swapped_names(names)
        return {**columns, **{c: columns[other[c]] for c in names}}

    return Change(
        frozenset(names),
        lambda s: swapped(s, names),
        line,
        STEP_COST * (len(names) // 2 - 1),
        seldom=True,
    )


def _heading(sign: int, turn: float) -> Change:
    """psi = sign psi + turn; east for north, or counted the other way round from the east."""

    def line(columns: dict[str, Column]) -> dict[str, Column]:
        psi = columns["psi"]
        size = psi.sign * psi.scale * psi.factor
        offset = psi.offset + sign * turn / size
        return {**columns, "psi": replace(psi, sign=sign * psi.sign, offset=offset)}

    return Change(
        frozenset(["psi"]),
        lambda s: {**s, "psi": sign * s["psi"] + turn} if "psi" in s else s,
        line,
        STEP_COST,
        seldom=True,
    )
