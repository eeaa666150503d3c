"""What the corrected model gains in flight: controllers designed on it and on the bare model.

A machine with hidden effects flies maneuvers; the flights are diagnosed; an LQG is designed and a
policy trained on the bare model and on the corrected one; all fly the machine itself, from the same
seeds. Designs differ in their model only: the same cost, integrals and disturbance estimator, and
actions centred on the bare model's trim for all. The policies begin from the same one, are trained for
as long and chosen in simulation, each on its own model.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from coax_env.diagnosis.diagnose import Diagnosis, diagnose
from coax_env.errors import InputError
from coax_env.logs.flight import Flight, read_flight
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.report import ControllerScores, figures
from coax_env.report.page import Section, bullets, command, figure, page, table
from coax_env.report.plot_style import AFTER, BEFORE, Figure
from coax_env.simulation.simulate import simulate
from controllers import lqr, trainings
from controllers.comparison import HEADER, ratio, score_words
from controllers.design_report import step_response
from controllers.evaluation import evaluate
from controllers.loading import Controller, load_controller

HIDDEN: Mapping[str, Mapping[str, float]] = {
    "motor_lag": {"upper": 0.08, "lower": 0.08},
    "torque_balance": {"scale": 0.07},
    "rotor_drag": {"coefficient": 4e-4},
}
"""What the default machine has and its bare model lacks, SI: sizes as usual, see effects.py.

A lag, a trim that is off and a force of the air, because controllers suffer from different ones: an
LQG from lags that it does not know, a policy from a trim that it has not met.
"""

MANEUVERS = (
    "hover", "lon_3211", "lat_3211", "heave_3211", "yaw_3211", "climb_descend", "forward_run",
    "side_run", "lon_doublet", "lat_doublet", "heading_turn", "differential_rpm",
)  # fmt: skip
MODELS = ("bare", "corrected")
COLOURS = (BEFORE, AFTER)
ROW_HEADER = HEADER[1:]
FIRST_TRAININGS = 3
"""Of a policy on the bare model, the best of which every model's begins from."""
FIRST_TEST_SEED = 1_000_000
"""Seeds of the flights that are scored begin so far above the one given: none was trained on."""


def default_machine(bare: Vehicle) -> Vehicle:
    """A vehicle with the HIDDEN effects."""
    for effect, values in HIDDEN.items():
        bare = bare.with_effect(effect, **values)
    return bare


def compare_models(
    machine: str | Vehicle | None = None,
    bare: str | Vehicle = "lama400d",
    flight: str | Path | Flight | None = None,
    out: str | Path = "runs/compare_models",
    episodes: int = 100,
    ppo_steps: int = 0,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> tuple[dict[str, Any], Diagnosis, dict[str, Controller]]:
    """Diagnose a machine's flights, and fly it with controllers of the bare and the corrected model.

    Args:
        machine: the true vehicle; default `bare` with the HIDDEN effects.
        bare: the model before the diagnosis.
        flight: the machine's flights; default MANEUVERS flown by it in simulation.
        out: folder of the policies.
        episodes: flights per controller.
        ppo_steps: env steps of each policy's training; 0: LQG only.
        seed: of the simulated flights, the training and the flights that are scored.
        progress: called with what is being done.

    Returns:
        models.json; the diagnosis; the controllers by ``"lqg bare"``, ``"lqg corrected"``, ...
    """
    report_progress = progress or (lambda text: None)
    bare = load_vehicle(bare)
    machine = default_machine(bare) if machine is None else load_vehicle(machine)
    if flight is None:
        report_progress("simulating maneuvers")
        flight = simulate(machine, MANEUVERS, seed=seed)
    flight = flight if isinstance(flight, Flight) else read_flight(flight)
    report_progress("diagnosing")
    result = diagnose(flight, bare, progress=lambda text: report_progress(f"diagnosing: {text}"))
    controllers: dict[str, Controller] = {}
    for name, model in zip(MODELS, (bare, result.vehicle_after), strict=True):
        controllers[f"lqg {name}"] = lqr.design(model, bare)
        if ppo_steps:
            report_progress(f"training on the {name} model")
            controllers[f"ppo {name}"] = train_policy(
                model, bare, Path(out) / "policies", name, seed, steps=ppo_steps
            )
    scores = {}
    for name, controller in controllers.items():
        report_progress(f"evaluating {name}")
        scores[name] = evaluate(controller, machine, episodes, seed=seed + FIRST_TEST_SEED)
    content = {
        "machine": machine.values(),
        "bare": bare.name,
        "hidden": sorted(machine.effects),
        "found": [cause["effect"] for cause in result.findings["causes"]],
        "verdict": result.findings["verdict"],
        "scores": scores,
        "cost_ratio": _cost_ratios(scores),
    }
    return content, result, controllers


def train_policy(
    model: Vehicle, bare: Vehicle, out: Path, name: str, seed: int = 0, **training: Any
) -> Controller:
    """The policy of one model, which begins as that of every other model of the machine does.

    Both sides begin from the best of FIRST_TRAININGS on the bare model, and each keeps what is best on
    its own model: see `trainings.train_best`, which does nothing again that lies there.

    Args:
        model: what it is for.
        bare: the vehicle as given, whose trim centres the actions.
        out: folder of the policies, those of all models.
        name: of the model's folder in it.
        seed: of the first training.
        training: further arguments of `trainings.train_best`, the same for all models.
    """
    training["nominal"] = bare
    seeds = range(seed, seed + FIRST_TRAININGS)
    trainings.train_best(bare, out / "first", seeds, **training)
    trainings.train_best(model, out / name, [], out / "first" / "policy.zip", **training)
    return load_controller(out / name / "policy.zip")


def _cost_ratios(scores: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Kind of controller -> mean cost on the bare model's design over that on the corrected one's."""
    kinds = dict.fromkeys(name.split()[0] for name in scores)
    return {k: ratio(scores[f"{k} bare"], scores[f"{k} corrected"]) for k in kinds}


def lqg_of_both(
    bare: Vehicle, corrected: Vehicle, machine: Vehicle, episodes: int = 20, seed: int = 0
) -> dict[str, tuple[lqr.LQG, dict[str, Any]]]:
    """An LQG designed on each model, both flown on one machine from the same seeds.

    Args:
        bare: the vehicle as given, whose trim centres both actions.
        corrected: the vehicle with the causes in it.
        machine: what they fly.
        episodes: flights each.
        seed: of the first flight.

    Returns:
        controller and score.json by MODELS.
    """
    result = {}
    for name, model in zip(MODELS, (bare, corrected), strict=True):
        controller = lqr.design(model, bare)
        result[name] = controller, evaluate(controller, machine, episodes, seed=seed)
    return result


def controller_scores(
    designs: Mapping[str, tuple[lqr.LQG, dict[str, Any]]], machine: str
) -> ControllerScores:
    """What a diagnosis' report shows of `lqg_of_both`; `machine` in words."""
    return ControllerScores(
        {name: score for name, (_, score) in designs.items()},
        machine,
        "An LQG (python-control) designed on each model, with the same cost and estimator.",
    )


def rows(content: Mapping[str, Any]) -> list[list[str]]:
    """The scores in words, under the comparison's header without its first column."""
    return [[name, *score_words(score)] for name, score in content["scores"].items()]


def models_page(
    content: Mapping[str, Any],
    controllers: Mapping[str, Controller],
    machine: Vehicle,
    command_line: str = "",
) -> str:
    """The report as HTML text.

    Args:
        content: models.json.
        controllers: of `compare_models`.
        machine: the true vehicle.
        command_line: what was typed.
    """
    gains = content["cost_ratio"]
    words = " and ".join(f"**{g:.1f} times** less with {k.upper()}" for k, g in gains.items())
    lead = [
        f"The same machine costs {words} to fly where the controller comes from the corrected model "
        "instead of the bare one.",
        f"Hidden in it: {', '.join(content['hidden'])}; named by the diagnosis: "
        f"{', '.join(content['found']) or 'nothing'}.",
    ]
    sections = [
        Section("Scores", _score_blocks(content)),
        Section("One flight of each", [
            figure(_flights(controllers, machine), "Of the true machine, from the same start"),
        ]),
        Section("What is the same for all", [bullets([
            "the cost, its weights, and the integrals of height, heading and speed",
            "the estimator's disturbances and biases, which explain what the model does not",
            "sensors, seeds, and actions centred on the bare model's trim",
        ])]),
    ]  # fmt: skip
    if command_line:
        sections.append(Section("How this was computed", [command(command_line)]))
    return page("What the corrected model gains in flight", lead, sections, kicker="Controllers")


def _score_blocks(content: Mapping[str, Any]) -> list[str]:
    """Cost and heading of every design as bars, and all scores as a table."""
    kinds = list(content["cost_ratio"])
    blocks: list[str] = []
    for key, title in (("mean_cost", "cost per step"), ("heading_rms_deg", "heading rms [deg]")):
        bars = {m: [content["scores"][f"{k} {m}"][key] for k in kinds] for m in MODELS}
        groups = [k.upper() for k in kinds]
        blocks.append(figure(figures.grouped_bars(groups, bars, title, colours=COLOURS)))
    return [*blocks, table(ROW_HEADER, rows(content), "On the true machine, from the same seeds")]


def _flights(controllers: Mapping[str, Controller], machine: Vehicle) -> Figure:
    """Heading and height of one flight with each controller."""
    panels: dict[str, dict[str, Any]] = {"heading [deg]": {}, "height [m]": {}}
    for name, controller in controllers.items():
        t, curves = step_response(controller, machine)
        named = dict(curves)
        panels["heading [deg]"][name] = named["attitude [deg]"]["heading"]
        panels["height [m]"][name] = named["height [m]"]["height"]
    return figures.histories(t, list(panels.items()))


def check_machine(path: str | Path | None, flight: str | Path | None) -> None:
    """A flight of one's own needs the machine that flew it."""
    if flight and not path:
        raise InputError("a flight needs --machine: the true vehicle that flew it")
