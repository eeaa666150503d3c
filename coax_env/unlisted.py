"""What no effect of the catalogue explains: which axis, and which states it follows.

The gust states of the filter soak up any force or moment that the model lacks. Where the innovations
stay coloured, those estimates are regressed on a small library of states and heading harmonics; what
one family of terms explains of them is reported in closed form. It is a description, not a cause.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from coax_env.engine.fit import RunPass
from coax_env.layout import GUST_FORCE, GUST_STATES, STATES

AXES = {
    "gust_X": ("ax", ("ax",)),
    "gust_Y": ("ay", ("ay",)),
    "gust_Z": ("az", ("az", "h", "vd")),
    "gust_L": ("p", ("p", "phi")),
    "gust_M": ("q", ("q", "theta")),
    "gust_N": ("r", ("r", "psi")),
}
"""Channel under which an axis is reported, and the channels it speaks for."""
HARMONICS = 4
SETTLING = 1.0  # s
SHARE = 0.4  # of an axis' estimated disturbance that one family must explain


def describe(passes: Sequence[RunPass], coloured: Sequence[str]) -> list[dict[str, Any]]:
    """Entries of findings.json's `unexplained` for the axes behind the coloured channels."""
    late = [p.record.t > p.record.t[0] + SETTLING for p in passes]
    x = np.concatenate([p.states[rows] for p, rows in zip(passes, late, strict=True)])
    found = []
    for i, (axis, unit) in enumerate(GUST_STATES):
        channel, family = AXES[axis]
        if not set(family) & set(coloured):
            continue
        share, depends_on, form = _best_term(x, x[:, GUST_FORCE.start + i], unit)
        if share > SHARE:
            found.append(
                {
                    "channel": channel,
                    "depends_on": [depends_on],
                    "share": round(share, 3),
                    "form": form,
                }
            )
    return sorted(found, key=lambda entry: -entry["share"])


def speaks_for(entries: Sequence[dict[str, Any]]) -> set[str]:
    """Channels whose colour these entries describe."""
    families = dict(AXES.values())
    return {c for entry in entries for c in families[entry["channel"]]}


def _best_term(x: np.ndarray, y: np.ndarray, unit: str) -> tuple[float, str, str]:
    psi = x[:, 12]
    best = (0.0, "", "")
    for k in range(1, HARMONICS + 1):
        angle = "psi" if k == 1 else f"{k} psi"
        columns = np.column_stack([np.sin(k * psi), np.cos(k * psi)])
        names = (f"sin({angle})", f"cos({angle})")
        best = max(best, _fit(columns, y, "psi", names, unit))
    for j, (name, _) in enumerate(STATES[:12]):
        column = x[:, j]
        columns = np.column_stack([column, np.abs(column) * column])
        best = max(best, _fit(columns, y, name, (name, f"|{name}| {name}"), unit))
    return best


def _fit(
    columns: np.ndarray, y: np.ndarray, depends_on: str, names: Sequence[str], unit: str
) -> tuple[float, str, str]:
    """Share of y's variance that the columns explain beside a constant, and the form in words."""
    spread = columns.std(0)
    if not np.all(spread > 1e-9) or not y.std() > 0.0:
        return 0.0, depends_on, ""
    design = np.column_stack([columns, np.ones(len(y))])
    coefficients = np.linalg.lstsq(design, y, rcond=None)[0]
    share = 1.0 - float(np.var(y - design @ coefficients) / np.var(y))
    sizes = np.abs(coefficients[:2]) * spread
    kept = [i for i in range(2) if sizes[i] > 0.2 * sizes.max()]
    form = " + ".join(f"{coefficients[i]:.3g} {names[i]}" for i in kept) + f" [{unit}]"
    return share, depends_on, form.replace("+ -", "- ")
