"""The report of the paper's own method: filters, states, the table, and what the table hides."""

from collections.abc import Sequence

import numpy as np

from coax_env.identification.two_step.method import PhysicalFit, Reconstructed, TwoStep
from coax_env.identification.two_step.modes import ModeFit
from coax_env.identification.two_step.processing import CUTOFF, ORDER, SEGMENT
from coax_env.identification.two_step.published import (
    direction,
    lift_artefact,
    predicted,
    table_viii,
)
from coax_env.identification.two_step.reconstruction import BIAS, THETA, H, U, W
from coax_env.identification.two_step.regression import MOST_INFLATION, Regression
from coax_env.plain_words import and_list, capital, number, plain, with_std
from coax_env.report import figures
from coax_env.report.page import (
    Section,
    bullets,
    callout,
    command,
    details,
    figure,
    page,
    prose,
    table,
)

POINTS = 500
DEGREES = 180.0 / np.pi
FAR = 3.0
"""Standard deviations from the physics at which an entry is marked."""
LETTERS = {
    "1": "0", "alpha_u": "α_u", "alpha_l": "α_l", "beta_u": "β_u", "beta_l": "β_l",
    "delta_lon": "δ_lon", "delta_lat": "δ_lat",
}  # fmt: skip


def two_step_page(result: TwoStep, command_line: str = "") -> str:
    """The report as HTML text."""
    lead = [_lead(result)]
    far = [fit for fit in result.modes if _far(fit)]
    if far:
        lead.append(
            f"In {and_list([fit.mode.name for fit in far])} the paper's form leaves entries more than "
            f"{FAR:.0f} standard deviations from what the vehicle file's physics gives."
        )
    tied = [fit for fit in result.modes if fit.tied.directions]
    if tied:
        words = _words(tied[0].tied.directions[0].words())
        lead.append(f"These maneuvers hardly move {words}: entries along it are not determined.")
    parts = [Section("The vehicle's numbers", [_numbers(result), *_remarks(result)])]
    parts += [Section(capital(fit.mode.name), _mode(fit)) for fit in result.modes]
    if result.reconstructed:
        shown = _longest(result.reconstructed)
        flaps = [_flapping(fit) for fit in result.modes if fit.mode.response == "C_m"]
        states = _states(shown, result.reconstructed)
        parts.append(Section("Step 1: the states", [*states, *flaps]))
        parts.append(Section("Processing", _processing(shown)))
    parts.append(Section("Table VIII examined", _published(result)))
    if command_line:
        parts.append(Section("How this was computed", [command(command_line)]))
    return page(
        f"The paper's two steps on {_count(len(result.flight.runs), 'run')} of {result.before.name}",
        lead,
        parts,
        kicker=f"Identification · vehicle {result.before.name}",
    )


def _lead(result: TwoStep) -> str:
    if not result.physical:
        return "Nothing in this flight moves enough for a regression."
    moved = max(
        (
            (abs(new.value - old.value) / old.std, name)
            for name in result.fitted
            for old, new in [(result.before[name], result.after[name])]
            if old.std > 0.0
        ),
        default=(0.0, ""),
    )
    return (
        f"{_count(len(result.fitted), 'number')} found; {plain(moved[1])} moved most, by "
        f"{number(moved[0], 2)} standard deviations of its prior."
    )


def _count(n: int, what: str) -> str:
    return f"{n} {what}" + ("" if n == 1 else "s")


def _remarks(result: TwoStep) -> list[str]:
    return [callout(remark, "note") for remark in result.remarks]


def _numbers(result: TwoStep) -> str:
    rows = []
    for fit in result.physical:
        for k, name in enumerate(fit.physics.parameters):
            old, new = result.before[name], result.after[name]
            rows.append(
                [
                    plain(name),
                    with_std(old.value, old.std, old.unit),
                    _alone(fit, k),
                    with_std(new.value, new.std, new.unit),
                ]
            )
    header = ["parameter", "file", "these flights alone", "joined"]
    note = prose(
        "From regressions in physical units: what is tied is pooled in one column, the gyroscopic "
        "moment is in it, nothing is divided by a rotor speed. Joined with the file by precision."
    )
    return table(header, rows) + note if rows else callout("No number is determined.", "warning")


def _alone(fit: PhysicalFit, k: int) -> str:
    index = fit.regression.names.index(fit.physics.regressors[k])
    factor, std = float(fit.regression.values[index]), float(fit.regression.std[index])
    if fit.physics.power < 0:
        factor, std = 1.0 / factor, std / factor**2
    return f"× {with_std(factor, std, '')}"


# --- modes --------------------------------------------------------------------------------------------


def _mode(fit: ModeFit) -> list[str]:
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
    blocks = [
        prose(f"{capital(fit.mode.source)}. Runs: {and_list(list(fit.runs))}."),
        table(header, rows, "value (std), std corrected for coloured residuals"),
    ]
    told = [
        f"**{_words(d.words())}** hardly moves ({100 * d.share:.0f} % of its largest part): the "
        "entries along it are known only together."
        for d in fit.tied.directions
    ]
    if fit.still:
        left_out = and_list([LETTERS.get(n, n) for n in fit.still])
        told.append(f"{left_out}: not moved by the maneuver beyond errors; left out.")
    if not fit.total.trusted:
        told.append("**The weakest direction does not stand out of the errors: not to be used.**")
    if told:
        blocks.append(bullets(told))
    regression = fit.completed or fit.total
    measured = fit.rows.columns[fit.mode.response]
    first = fit.rows.lengths[0]
    estimated = measured - regression.residual
    panels = [
        (
            fit.mode.response,
            {"measured": measured[:first], "estimated": estimated[:first]},
        ),
        ("difference", {"difference": regression.residual[:first]}),
    ]
    caption = f"{fit.runs[0]}: as the paper's Figures 27 to 29."
    blocks.append(figure(figures.histories(fit.rows.t[:first], panels, POINTS), caption))
    return blocks


def _entry(regression: Regression, name: str) -> str:
    if name not in regression.names:
        return "–"
    k = regression.names.index(name)
    return f"{number(float(regression.values[k]), 3)} ({number(float(regression.std[k]), 2)})"


def _physics(fit: ModeFit, name: str) -> str:
    """What the physics gives; 0 where it is far below what the regression could tell from it."""
    regression = fit.completed if name not in fit.total.names and fit.completed else fit.total
    std = regression.std[regression.names.index(name)]
    value = fit.expected[name]
    return number(value if abs(value) > 0.05 * std else 0.0, 3)


def _inflation(fit: ModeFit, name: str) -> str:
    value = fit.tied.inflation.get(name)
    if value is None:
        return "–"
    return f"**{value:.1f}**" if value > MOST_INFLATION else f"{value:.1f}"


def _far(fit: ModeFit) -> list[str]:
    """Entries of the paper's form that are far from the physics, the intercept aside."""
    away = np.abs(fit.total.values - [fit.expected[n] for n in fit.total.names]) / fit.total.std
    return [n for n, a in zip(fit.total.names, away, strict=True) if a > FAR and n != "1"]


def _words(text: str) -> str:
    for name, letter in LETTERS.items():
        if name != "1":
            text = text.replace(name, letter)
    return text.replace(" - ", " − ")


# --- states and filters -------------------------------------------------------------------------------


def _longest(runs: Sequence[Reconstructed]) -> Reconstructed:
    """The run whose pitch rate moves most: the longitudinal maneuver, where there is one."""
    return max(runs, key=lambda run: float(run.smooth["q"].std()))


def _states(shown: Reconstructed, runs: Sequence[Reconstructed]) -> list[str]:
    states = shown.states
    panels = []
    for name, state, k, factor in (
        ("u [m/s]", "u", U, 1.0),
        ("w [m/s]", "w", W, 1.0),
        ("pitch [deg]", "theta", THETA, DEGREES),
    ):
        curves = {
            "filter": factor * states.states[:, k],
            "smoother": factor * states.smoothed[:, k],
            "integrated IMU": factor * shown.integrated[state],
        }
        if k == THETA and "theta" in shown.raw:
            curves["compass"] = DEGREES * shown.raw["theta"]
        panels.append((name, curves))
    height = states.states[:, H]
    heard = _heard(shown)
    residual = np.interp(shown.t, shown.t[heard], states.residual[heard])
    rows = [
        [
            run.run,
            with_std(float(run.states.states[-1, BIAS]), float(run.states.std[-1, BIAS]), "m/s²"),
            f"{float(np.nanstd(run.states.residual)):.3f} m",
            f"{100 * float(np.mean(np.abs(run.states.residual[_heard(run)]) < 0.1)):.0f} %",
            f"{float(run.states.std[-1, U]):.2f} m/s",
        ]
        for run in runs
    ]
    return [
        prose(
            "Five states θ u w h λ, the sonar the only measurement, (46)–(57). The height alone hardly "
            "observes u: it is dead reckoned from rest, and its std grows."
        ),
        table(
            ["run", "bias of a_z", "height residual, rms", "within 0.1 m", "std of u at the end"],
            rows,
        ),
        figure(
            figures.histories(shown.t, panels, POINTS), f"{shown.run}: as the paper's Figure 23."
        ),
        figure(
            figures.histories(
                shown.t,
                [
                    ("bias of a_z [m/s²]", {"filter": states.states[:, BIAS]}),
                    (
                        "height [m]",
                        {
                            "sonar": shown.raw["h"],
                            "filter": height,
                            "integrated IMU": shown.integrated["h"],
                        },
                    ),
                    ("residual [m]", {"sonar − filter": residual}),
                ],
                POINTS,
            ),
            "As the paper's Figures 24 and 25.",
        ),
    ]


def _flapping(fit: ModeFit) -> str:
    first = fit.rows.lengths[0]
    curves = {
        LETTERS[name]: DEGREES * fit.rows.columns[name][:first]
        for name in ("alpha_l", "alpha_u", "delta_lon")
    }
    caption = f"{fit.runs[0]}: as the paper's Figure 26, low-passed."
    return figure(figures.histories(fit.rows.t[:first], [("tilt [deg]", curves)], POINTS), caption)


def _heard(run: Reconstructed) -> np.ndarray:
    return np.isfinite(run.states.residual)


def _processing(shown: Reconstructed) -> list[str]:
    panels = [
        (
            f"{c} [{unit}]",
            {
                "as read": factor * shown.raw[c],
                "low-pass": factor * shown.smooth[c],
                "spectral": factor * shown.spectral[c],
            },
        )
        for c, unit, factor in (("q", "deg/s", DEGREES), ("ax", "m/s²", 1.0), ("az", "m/s²", 1.0))
    ]
    return [
        prose(
            f"Butterworth of order {ORDER} at {CUTOFF:g} Hz, forwards and backwards; then the "
            f"spectral-amplitude filter: segments of {SEGMENT:g} s, half overlapping, the hover "
            "record's amplitudes taken off, phases kept. The regressions use the low-pass alone: "
            "taking amplitudes off is not linear, so a linear relation would not survive it."
        ),
        figure(figures.histories(shown.t, panels, POINTS), shown.run),
    ]


# --- the published table ------------------------------------------------------------------------------


def _published(result: TwoStep) -> list[str]:
    rows_printed = table_viii()
    theory = predicted(result.before)
    rows = []
    for printed in rows_printed:
        for name, value in printed.values.items():
            expected = theory[printed.response][name]
            away = abs(value - expected) / printed.std[name]
            rows.append(
                [
                    f"{printed.response}, {LETTERS.get(name, name)}",
                    f"{value:g} ({printed.std[name]:g})",
                    number(expected, 3),
                    f"**{away:.0f}**" if away > FAR else f"{away:.1f}",
                ]
            )
    ties = direction(rows_printed)
    gain = result.before["swash_to_flap"].value
    artefact = lift_artefact(result.before)
    shared = ", ".join(f"{delta:.2f}, {q:.2f} ({c})" for c, (delta, q) in ties.items())
    return [
        prose(
            "The published entries against what the paper's own Tables I to V give for them at "
            f"2000/2143 rpm (vehicle file {result.before.name})."
        ),
        bullets(
            [
                f"**One direction.** Eq (26) ties α_l − {gain:g} δ_lon + τ q, which hardly moves away "
                "from the doublet's edges. The rows' δ_lon and q entries over their α_l entry: "
                f"{shared} – the same direction three times, as a nearly collinear pair leaves it.",
                "**Dividing by ω_u².** With a_z constant, m g / (½ k_T ω_u²) regressed on 1, T_l, T_u "
                f"gives {artefact['1']:.4f}, {artefact['T_l']:.4f}, {artefact['T_u']:.4f}: the "
                "published C_Z row, without any flight.",
                "**A missing term.** (69) has no p, though (36) has the gyroscopic p H. The table of "
                "the pitching moment above gives it beside the paper's form.",
                "**Remedy.** Pool what is tied and add the missing term (the numbers above), or fit "
                "the physical parameters through the whole model: `scripts/identify.py --method ml`.",
            ]
        ),
        details(
            "Every entry",
            table(["entry", "printed (std)", "the paper's tables give", "printed std away"], rows),
        ),
    ]
