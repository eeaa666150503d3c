"""The end of a diagnosis' report: the search step by step, the innovations, how it was computed."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from coax_env.estimation.whiteness import SHARE
from coax_env.model import effects
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import channel_name, number, plain, with_std
from coax_env.report import fit_figures
from coax_env.report.flight_data import ordered
from coax_env.report.page import chooser, command, details, figure, prose, side_by_side, table
from coax_env.report.plot_style import Figure

if TYPE_CHECKING:
    from coax_env.diagnosis.diagnose import Diagnosis

MOST_INNOVATION_FIGURES = 60


def detail_blocks(result: "Diagnosis", command_line: str) -> list[str]:
    """The search, the innovations, the method and the changed parameters, folded away."""
    shares = _predictable_shares(result)
    search = _search_figures(result, shares)
    innovations = _innovation_figures(result, shares)
    changed = changed_parameters(result.vehicle_before, result.vehicle_after)
    return [
        command(command_line) if command_line else "",
        details("The search, step by step", side_by_side(search)) if search else "",
        details("Innovations, run by run", chooser(innovations, _INNOVATIONS))
        if innovations
        else "",
        details("How this was computed", prose(_METHOD)),
        details(
            f"{len(changed)} parameters of the vehicle file changed",
            table(["parameter", "bare", "corrected"], changed),
        )
        if changed
        else "",
    ]


_INNOVATIONS = """
Innovation: the reading less what the filter predicted from all before it, in units of its own standard
deviation. A level of 1 above, and nothing outside the band below, mean that the model misses nothing.
"""

_METHOD = """
One extended Kalman filter of the full model runs over each run. The sensitivity of the innovations to
every effect of the catalogue is compared with the innovations that are left (score test). The best
effect is added, everything is fitted again, and causes already chosen are dropped or exchanged where
that helps. Base parameters keep their priors. Causes and gain come from the runs that were not held
out; the vehicle file is then fitted on all runs with the same structure.
"""


def _predictable_shares(result: "Diagnosis") -> dict[str, tuple[float, float]]:
    """Channel -> share of its innovations that their own past predicts: bare, corrected."""
    bare, corrected = (result.whiteness.get(key, {}) for key in ("before", "after"))
    return {
        c: (bare[c].coloured_share, corrected[c].coloured_share)
        for c in ordered(bare)
        if c in corrected
    }


def _search_figures(result: "Diagnosis", shares: Mapping[str, tuple[float, float]]) -> list[str]:
    blocks: list[str] = []
    if result.evidence_history:
        steps = [(_step_name(name), gain) for name, gain in result.evidence_history]
        caption = "How much each step of the search raised the log-likelihood."
        blocks.append(figure(fit_figures.evidence_steps(steps), caption))
    if shares:
        caption = (
            "Share of each channel's innovations that their own past predicts. Left of the green "
            "line a channel counts as white."
        )
        blocks.append(figure(fit_figures.whiteness_bars(shares, SHARE), caption))
    return blocks


def _step_name(step: str) -> str:
    """``+ rotor_drag`` as ``+ rotor drag``; only names of effects change."""
    return " ".join(plain(word) if word in effects.CATALOGUE else word for word in step.split())


def _innovation_figures(
    result: "Diagnosis", shares: Mapping[str, tuple[float, float]]
) -> dict[tuple[str, str], Figure]:
    """Figures by run and channel: of each run those channels that were least white before."""
    options = {}
    runs = result.innovations_before
    each = max(3, MOST_INNOVATION_FIGURES // max(len(runs), 1))
    least_white = {w.run: w.coloured_share for w in result.whiteness.get("before", {}).values()}
    for run in sorted(runs, key=lambda name: -least_white.get(name, 0.0)):
        bare, corrected = runs[run], result.innovations_after.get(run, {})
        channels = sorted(
            (c for c in ordered(bare) if c in corrected),
            key=lambda c: -shares.get(c, (0.0, 0.0))[0],
        )
        for c in channels[:each]:
            options[run, channel_name(c)] = fit_figures.innovations(
                bare["t"], bare[c], corrected[c]
            )
    return options


def changed_parameters(bare: Vehicle, corrected: Vehicle) -> Sequence[Sequence[str]]:
    """Parameters whose value differs: name, value before, value with std after."""
    old = bare.values()
    return [
        [plain(name), number(old.get(name, math.nan), 4), with_std(p.value, p.std, p.unit)]
        for name in corrected.values()
        if (p := corrected[name]).value != old.get(name)
    ]
