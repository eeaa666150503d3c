"""The report of the paper's own method: filters, states, its Table VIII, and what the table hides."""

from coax_env.identification.two_step.method import PhysicalFit, TwoStep
from coax_env.identification.two_step.published import (
    direction,
    lift_artefact,
    predicted,
    table_viii,
)
from coax_env.plain_words import and_list, capital, number, plain, with_std
from coax_env.report.page import Section, bullets, callout, command, details, page, prose, table
from coax_env.report.two_step_modes import (
    LETTERS,
    MARKED_FROM,
    far_from_physics,
    in_letters,
    mode_blocks,
)
from coax_env.report.two_step_states import (
    flapping_figure,
    longitudinal_run,
    processing_blocks,
    state_blocks,
)


def two_step_page(result: TwoStep, command_line: str = "") -> str:
    """The report as HTML text."""
    lead = [_lead(result)]
    far = [fit for fit in result.modes if far_from_physics(fit)]
    if far:
        lead.append(
            f"In {and_list([fit.mode.name for fit in far])} the paper's form leaves entries more than "
            f"{MARKED_FROM:.0f} standard deviations from what the vehicle file's physics gives."
        )
    tied = [fit for fit in result.modes if fit.tied.directions]
    if tied:
        words = in_letters(tied[0].tied.directions[0].words())
        lead.append(f"These maneuvers hardly move {words}: entries along it are not determined.")
    sections = [Section("The vehicle's parameters", [_parameters(result), *_remarks(result)])]
    sections += [Section(capital(fit.mode.name), mode_blocks(fit)) for fit in result.modes]
    if result.reconstructed:
        shown = longitudinal_run(result.reconstructed)
        flaps = [flapping_figure(fit) for fit in result.modes if fit.mode.response == "C_m"]
        states = state_blocks(shown, result.reconstructed)
        sections.append(Section("Step 1: the states", [*states, *flaps]))
        sections.append(Section("Processing", processing_blocks(shown)))
    sections.append(Section("Table VIII examined", _published(result)))
    if command_line:
        sections.append(Section("How this was computed", [command(command_line)]))
    return page(
        f"The paper's two steps on {_count(len(result.flight.runs), 'run')} of {result.before.name}",
        lead,
        sections,
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
        f"{_count(len(result.fitted), 'parameter')} found; {plain(moved[1])} moved most, by "
        f"{number(moved[0], 2)} standard deviations of its prior."
    )


def _count(n: int, what: str) -> str:
    return f"{n} {what}" + ("" if n == 1 else "s")


def _remarks(result: TwoStep) -> list[str]:
    return [callout(remark, "note") for remark in result.remarks]


def _parameters(result: TwoStep) -> str:
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
    header = ["parameter", "file", "these flights alone", "combined"]
    note = prose(
        "From regressions in physical units: collinear regressors are pooled in one column, the "
        "gyroscopic moment is included, nothing is divided by a rotor speed. Combined with the file "
        "by precision."
    )
    return table(header, rows) + note if rows else callout("No parameter is determined.", "warning")


def _alone(fit: PhysicalFit, k: int) -> str:
    index = fit.regression.names.index(fit.physics.regressors[k])
    factor, std = float(fit.regression.values[index]), float(fit.regression.std[index])
    if fit.physics.power < 0:
        factor, std = 1.0 / factor, std / factor**2
    return f"× {with_std(factor, std, '')}"


# --- the published table ------------------------------------------------------------------------------


def _published(result: TwoStep) -> list[str]:
    """Table VIII against what the paper's own Tables I to V give."""
    ties = direction(table_viii())
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
                f"**One direction.** By (26) α_l − {gain:g} δ_lon + τ q hardly moves away from the "
                "doublet's edges. The rows' δ_lon and q entries over their α_l entry: "
                f"{shared} – the same direction three times, as a nearly collinear pair leaves it.",
                "**Dividing by ω_u².** With a_z constant, m g / (½ k_T ω_u²) regressed on 1, T_l, T_u "
                f"gives {artefact['1']:.4f}, {artefact['T_l']:.4f}, {artefact['T_u']:.4f}: the "
                "published C_Z row, without any flight.",
                "**A missing term.** (69) has no p, though (36) has the gyroscopic p H. The table of "
                "the pitching moment above gives it beside the paper's form.",
                "**Remedy.** Pool what is collinear and add the missing term (the parameters "
                "above), or fit the physical parameters through the whole model: "
                "`scripts/identify.py --method ml`.",
            ]
        ),
        details(
            "Every entry",
            table(
                ["entry", "printed (std)", "the paper's tables give", "printed std away"],
                _published_rows(result),
            ),
        ),
    ]


def _published_rows(result: TwoStep) -> list[list[str]]:
    """Every published entry, what the paper's tables give for it, and how far it is off."""
    theory = predicted(result.before)
    rows = []
    for printed in table_viii():
        for name, value in printed.values.items():
            expected, std = theory[printed.response][name], printed.std[name]
            away = abs(value - expected) / std
            rows.append(
                [
                    f"{printed.response}, {LETTERS.get(name, name)}",
                    f"{value:g} ({std:g})",
                    number(expected, 3),
                    f"**{away:.0f}**" if away > MARKED_FROM else f"{away:.1f}",
                ]
            )
    return rows
