"""Step 1 of the paper's method on a page: signal processing, reconstructed states, flapping."""

from collections.abc import Sequence

import numpy as np

from coax_env.identification.two_step.method import Reconstructed
from coax_env.identification.two_step.modes import ModeFit
from coax_env.identification.two_step.processing import CUTOFF, ORDER, SEGMENT
from coax_env.identification.two_step.reconstruction import BIAS, THETA, H, U, W
from coax_env.plain_words import with_std
from coax_env.report import figures
from coax_env.report.page import figure, prose, table
from coax_env.report.two_step_modes import LETTERS, POINTS

DEGREES = 180.0 / np.pi


def longitudinal_run(runs: Sequence[Reconstructed]) -> Reconstructed:
    """The run whose pitch rate moves most: the longitudinal maneuver, where there is one."""
    return max(runs, key=lambda run: float(run.smooth["q"].std()))


def state_blocks(shown: Reconstructed, runs: Sequence[Reconstructed]) -> list[str]:
    """States of one run as figures, and figures of merit of every run."""
    return [
        prose(
            "Five states θ u w h λ, the sonar the only measurement, (46)–(57). The height alone hardly "
            "observes u: it is dead reckoned from rest, and its std grows."
        ),
        _merits(runs),
        figure(
            figures.histories(shown.t, _state_panels(shown), POINTS),
            f"{shown.run}: as the paper's Figure 23.",
        ),
        figure(
            figures.histories(shown.t, _height_panels(shown), POINTS),
            "As the paper's Figures 24 and 25.",
        ),
    ]


def _merits(runs: Sequence[Reconstructed]) -> str:
    """Bias, residual and final uncertainty of every run."""
    header = ["run", "bias of a_z", "height residual, rms", "within 0.1 m", "std of u at the end"]
    rows = [
        [
            run.run,
            with_std(float(run.states.states[-1, BIAS]), float(run.states.std[-1, BIAS]), "m/s²"),
            f"{float(np.nanstd(run.states.residual)):.3f} m",
            f"{100 * float(np.mean(np.abs(run.states.residual[_updated(run)]) < 0.1)):.0f} %",
            f"{float(run.states.std[-1, U]):.2f} m/s",
        ]
        for run in runs
    ]
    return table(header, rows)


def _state_panels(shown: Reconstructed) -> list[tuple[str, dict[str, np.ndarray]]]:
    states, panels = shown.states, []
    for title, name, k, factor in (
        ("u [m/s]", "u", U, 1.0),
        ("w [m/s]", "w", W, 1.0),
        ("pitch [deg]", "theta", THETA, DEGREES),
    ):
        curves = {
            "filter": factor * states.states[:, k],
            "smoother": factor * states.smoothed[:, k],
            "integrated IMU": factor * shown.integrated[name],
        }
        if k == THETA and "theta" in shown.raw:
            curves["compass"] = DEGREES * shown.raw["theta"]
        panels.append((title, curves))
    return panels


def _height_panels(shown: Reconstructed) -> list[tuple[str, dict[str, np.ndarray]]]:
    states, updated = shown.states, _updated(shown)
    height = {
        "sonar": shown.raw["h"],
        "filter": states.states[:, H],
        "integrated IMU": shown.integrated["h"],
    }
    residual = np.interp(shown.t, shown.t[updated], states.residual[updated])
    return [
        ("bias of a_z [m/s²]", {"filter": states.states[:, BIAS]}),
        ("height [m]", height),
        ("residual [m]", {"sonar − filter": residual}),
    ]


def _updated(run: Reconstructed) -> np.ndarray:
    """Samples at which the sonar gave a reading."""
    return np.isfinite(run.states.residual)


def flapping_figure(fit: ModeFit) -> str:
    """Tip-path tilts and command of the first run."""
    first = fit.rows.lengths[0]
    curves = {
        LETTERS[name]: DEGREES * fit.rows.columns[name][:first]
        for name in ("alpha_l", "alpha_u", "delta_lon")
    }
    caption = f"{fit.runs[0]}: as the paper's Figure 26, low-passed."
    return figure(figures.histories(fit.rows.t[:first], [("tilt [deg]", curves)], POINTS), caption)


def processing_blocks(shown: Reconstructed) -> list[str]:
    """The low-pass and the spectral-amplitude filter on one run."""
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
