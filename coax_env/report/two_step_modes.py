"""The regressions of the paper's method on a page: one table and one figure for each equation."""

import numpy as np

from coax_env.identification.two_step.modes import ModeFit
from coax_env.identification.two_step.regression import MOST_INFLATION, Regression
from coax_env.plain_words import and_list, capital, number
from coax_env.report import figures
from coax_env.report.page import bullets, figure, prose, table

POINTS = 500
"""Per curve of a figure."""
MARKED_FROM = 3.0
"""Standard deviations from the physics at which an entry is marked."""
LETTERS = {
    "1": "0", "alpha_u": "α_u", "alpha_l": "α_l", "beta_u": "β_u", "beta_l": "β_l",
    "delta_lon": "δ_lon", "delta_lat": "δ_lat",
}  # fmt: skip
"""The paper's letters of the regressors."""


def mode_blocks(fit: ModeFit) -> list[str]:
    """One equation: its entries beside the physics, what is collinear, and the fit over time."""
    blocks: list[str] = [
        prose(f"{capital(fit.mode.source)}. Runs: {and_list(list(fit.runs))}."),
        _entries(fit),
    ]
    remarks = _collinearity(fit)
    if remarks:
        blocks.append(bullets(remarks))
    return [*blocks, _fit_figure(fit)]


def _entries(fit: ModeFit) -> str:
    """Every entry as each regression has it, what the file's physics gives, and its inflation."""
    names = list(fit.ordinary.names)
    columns = [("least squares", fit.ordinary), ("total least squares", fit.total)]
    if fit.completed:
        columns.append(("with " + and_list(list(fit.mode.completed)), fit.completed))
        names += [n for n in fit.completed.names if n not in names]
    rows = [
        [
            f"{fit.mode.response}, {LETTERS.get(name, name)}",
            *(_entry(regression, name) for _, regression in columns),
            _physics(fit, name),
            _inflation(fit, name),
        ]
        for name in names
    ]
    header = ["entry", *(title for title, _ in columns), "the file's physics", "variance inflation"]
    return table(header, rows, "value (std), std corrected for coloured residuals")


def _collinearity(fit: ModeFit) -> list[str]:
    """Combinations that the maneuver does not determine, in words."""
    remarks = [
        f"**{in_letters(d.words())}** hardly moves ({100 * d.share:.0f} % of its largest part): the "
        "entries along it are known only together."
        for d in fit.tied.directions
    ]
    if fit.still:
        left_out = and_list([LETTERS.get(n, n) for n in fit.still])
        remarks.append(f"{left_out}: not excited beyond the measurement error; left out.")
    if not fit.total.trusted:
        remarks.append("**The weakest direction does not exceed the errors: not to be used.**")
    return remarks


def _fit_figure(fit: ModeFit) -> str:
    """Measured and estimated response of the first run."""
    regression = fit.completed or fit.total
    response, length = fit.mode.response, fit.rows.lengths[0]
    measured, residual = fit.rows.columns[response][:length], regression.residual[:length]
    panels = [
        (response, {"measured": measured, "estimated": measured - residual}),
        ("difference", {"difference": residual}),
    ]
    caption = f"{fit.runs[0]}: as the paper's Figures 27 to 29."
    return figure(figures.histories(fit.rows.t[:length], panels, POINTS), caption)


def _entry(regression: Regression, name: str) -> str:
    if name not in regression.names:
        return "–"
    k = regression.names.index(name)
    return f"{number(float(regression.values[k]), 3)} ({number(float(regression.std[k]), 2)})"


def _physics(fit: ModeFit, name: str) -> str:
    """What the physics gives; 0 where the regression could not distinguish it from that."""
    regression = fit.completed if name not in fit.total.names and fit.completed else fit.total
    std = regression.std[regression.names.index(name)]
    value = fit.expected[name]
    return number(value if abs(value) > 0.05 * std else 0.0, 3)


def _inflation(fit: ModeFit, name: str) -> str:
    value = fit.tied.inflation.get(name)
    if value is None:
        return "–"
    return f"**{value:.1f}**" if value > MOST_INFLATION else f"{value:.1f}"


def far_from_physics(fit: ModeFit) -> list[str]:
    """Entries of the paper's form that are far from the physics, the intercept aside."""
    away = np.abs(fit.total.values - [fit.expected[n] for n in fit.total.names]) / fit.total.std
    return [n for n, a in zip(fit.total.names, away, strict=True) if a > MARKED_FROM and n != "1"]


def in_letters(text: str) -> str:
    """A combination of regressors in the paper's letters."""
    for name, letter in LETTERS.items():
        if name != "1":
            text = text.replace(name, letter)
    return text.replace(" - ", " − ")
