"""What correcting the model is worth in flight, over many machines that hide effects.

A machine is the bare vehicle with two to four effects, drawn from its seed with the sizes of the
catalogue. It flies model_comparison.MANEUVERS in simulation, the flight is diagnosed, and controllers
of the bare and of the corrected model fly the machine from the same seeds.

What a controller takes from a model: LQG its filter and its gains, PPO the world it is trained in, PID
the trim alone, as a feed-forward. ``lqg_hedged`` reckons with lags that its model does not name
(lqr.HEDGE): what correcting is worth where that has been done.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.diagnosis.diagnose import diagnose
from coax_env.env import tasks
from coax_env.errors import InputError
from coax_env.files import write_json, write_text
from coax_env.logs.flight import Flight
from coax_env.model.usual_sizes import sized_for
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle, vehicle_toml
from coax_env.report import figures
from coax_env.report.page import Section, bullets, command, figure, page, prose, table
from coax_env.simulation.simulate import simulate
from controllers import lqr, pid
from controllers.comparison import TARGET_SENSORS
from controllers.evaluation import evaluate
from controllers.loading import Controller
from controllers.model_comparison import FIRST_TEST_SEED, MANEUVERS, MODELS, train_policy

EITHER_SIGN = (
    "thrust_scale", "torque_balance", "yaw_inertia", "swash_gain", "flybar_time_constant",
    "swash_phase", "swash_offset", "cg_offset", "gyro_bias",
)  # fmt: skip
HIDEABLE = (
    *EITHER_SIGN, "added_mass", "motor_lag", "servo_lag", "command_delay", "motor_droop",
    "rotor_drag", "airframe_drag", "axial_damping", "rate_damping", "yaw_damping", "flap_blowback",
    "hub_stiffness", "spin_up_reaction",
)  # fmt: skip
"""Effects that a machine may hide: those of the body, rotors and actuators, and a bias of the gyros."""
FEWEST, MOST = 2, 4
SIZES = (0.5, 1.5)  # of the usual size, uniform
_RESAMPLES = 2000
_FULL_PRICE = 1.05  # a ratio above which correcting was a loss
_HALF = 0.5


def draw_machine(bare: Vehicle, seed: int) -> Vehicle:
    """The machine of a seed: `bare` with two to four effects of HIDEABLE."""
    rng = np.random.default_rng([seed, 21])
    names = rng.choice(HIDEABLE, size=rng.integers(FEWEST, MOST + 1), replace=False)
    machine = bare
    for name in names:
        values = {}
        for parameter in sized_for(bare, str(name)):
            sign = rng.choice((-1.0, 1.0)) if name in EITHER_SIGN else 1.0
            values[parameter.name] = float(sign * parameter.usual * rng.uniform(*SIZES))
        machine = machine.with_effect(str(name), **values)
    return machine


def fly_machine(
    seed: int,
    bare: Vehicle,
    out: Path,
    episodes: int = 50,
    ppo_steps: int = 0,
    truth: bool = False,
    progress: Callable[[str], None] | None = None,
    **world: Any,
) -> dict[str, Any]:
    """Diagnose one machine's simulated flight, and fly it with controllers of both models.

    What `result_path` says is done is not done again: neither the diagnosis, whose corrected model
    lies beside the result as a vehicle file, nor the flights of a kind of controller.

    Args:
        seed: of the machine, its flight and the flights that are scored.
        bare: the model before the diagnosis.
        out: folder of the results, and of the policies; that of the bare model is trained once, for
            all machines.
        episodes: flights per controller.
        ppo_steps: env steps of each policy's training; 0: no PPO.
        truth: the corrected model is the machine itself, without a diagnosis: the most that any
            correction can gain.
        progress: called with what is being done.
        world: arguments of the env that they fly and PPO is trained in, such as ``task`` and ``wind``:
            the same for all results of a folder.

    Returns:
        what was hidden and named, and by kind of controller the cost of every flight, bare and
        corrected.
    """
    report_progress = progress or (lambda text: None)
    machine, path = draw_machine(bare, seed), result_path(out, seed, truth)
    found = _stored(path)
    if found is None:
        report_progress(f"machine {seed}: {', '.join(machine.effects)}: diagnosing")
        found = _diagnosed(seed, machine, bare, path, truth) | {"world": world}
    elif found.get("world", {}) != json.loads(json.dumps(world)):
        raise InputError(f"{path} was flown in another world: {found.get('world', {})}")
    corrected = load_vehicle(path.with_suffix(".toml"))
    for kind, make in _designs(seed, bare, out, ppo_steps, world).items():
        if kind in found["scores"]:
            continue
        flown = {}
        for name, model in zip(MODELS, (bare, corrected), strict=True):
            report_progress(f"machine {seed}: {kind} {name}")
            score = evaluate(
                make(model, name), machine, episodes, seed=seed + FIRST_TEST_SEED, each_flight=True,
                **world,
            )  # fmt: skip
            flown[name] = {key: score[key] for key in ("mean_cost", "success_rate", "flight_costs")}
        found["scores"][kind] = flown
        write_json(path, found)
    return found


def _diagnosed(
    seed: int, machine: Vehicle, bare: Vehicle, path: Path, truth: bool
) -> dict[str, Any]:
    """A machine's result without flights; it and the corrected vehicle are written to `path`."""
    if truth:
        corrected, named, verdict = machine, list(machine.effects), "the truth"
    else:
        corrected, named, verdict = _named(simulate(machine, MANEUVERS, seed=seed), bare)
    found = {
        "seed": seed,
        "hidden": {
            name: {key: parameter.value for key, parameter in group.items()}
            for name, group in machine.effects.items()
        },
        "named": named,
        "verdict": verdict,
        "scores": {},
    }
    write_text(path.with_suffix(".toml"), vehicle_toml(corrected))
    write_json(path, found)
    return found


def _named(flight: Flight, bare: Vehicle) -> tuple[Vehicle, list[str], str]:
    """Corrected vehicle, causes, verdict; `bare` stays where the diagnosis refuses the flight."""
    try:
        result = diagnose(flight, bare)
    except InputError as refusal:
        return bare, [], f"no diagnosis: {refusal}"
    causes = [cause["effect"] for cause in result.findings["causes"]]
    return result.vehicle_after, causes, result.findings["verdict"]


def _designs(
    seed: int, bare: Vehicle, out: Path, ppo_steps: int, world: Mapping[str, Any]
) -> dict[str, Callable[[Vehicle, str], Controller]]:
    """How a controller of each kind is made of a model and its name."""
    aims = tasks.task(world.get("task", "hover")).shows_target
    sensors, limits = (TARGET_SENSORS, lqr.BRISK) if aims else ("onboard", None)
    found: dict[str, Callable[[Vehicle, str], Controller]] = {
        "lqg": lambda model, _: lqr.design(model, bare, sensors, limits),
        "lqg_hedged": lambda model, _: lqr.design(model, bare, sensors, limits, hedge=lqr.HEDGE),
        "pid": lambda model, _: pid.design(model, bare, sensors),
    }
    if ppo_steps:
        training = {"steps": ppo_steps, "sensors": sensors, **_learnt_in(world)}
        found["ppo"] = lambda model, name: train_policy(
            model,
            bare,
            out / "policies",
            name if name == MODELS[0] else f"{name}_{seed}",
            **training,
        )
    return found


def _learnt_in(world: Mapping[str, Any]) -> dict[str, Any]:
    """Task and world as arguments of `trainings.train_best`."""
    air = dict(world)
    return {"task": air.pop("task", "hover"), "world": air}


def fly_machines(
    seeds: Sequence[int],
    bare: str | Vehicle,
    out: Path,
    episodes: int = 50,
    ppo_steps: int = 0,
    truth: bool = False,
    progress: Callable[[str], None] | None = None,
    **world: Any,
) -> Iterator[dict[str, Any]]:
    """`fly_machine` of every seed; arguments as there. With `truth` results lie in OUT/truth."""
    bare = load_vehicle(bare)
    for seed in seeds:
        yield fly_machine(seed, bare, out, episodes, ppo_steps, truth, progress, **world)


def result_path(out: Path, seed: int, truth: bool = False) -> Path:
    """Where a machine's result lies.

    Args:
        out: folder of all results. seed: the machine's. truth: whether its model was the truth.
    """
    return out / ("truth" if truth else "machines") / f"{seed:06d}.json"


def stored_results(out: Path, seeds: Sequence[int], truth: bool = False) -> list[dict[str, Any]]:
    """Those of these machines whose results lie there; arguments as of `result_path`."""
    found = [_stored(result_path(out, seed, truth)) for seed in seeds]
    return [one for one in found if one]


def _stored(path: Path) -> dict[str, Any] | None:
    """A result that lies there with its vehicle."""
    if not (path.exists() and path.with_suffix(".toml").exists()):
        return None
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def cost_ratio(scores: Mapping[str, Any], seed: int = 0) -> tuple[float, float, float]:
    """Cost of the corrected model's controller over that of the bare one's, and its 95 % interval.

    From the flights, which have the same seeds: they are drawn again in pairs.
    """
    bare, corrected = (np.array(scores[name]["flight_costs"]) for name in MODELS)
    draws = np.random.default_rng(seed).integers(0, len(bare), (_RESAMPLES, len(bare)))
    low, high = np.percentile(corrected[draws].sum(1) / bare[draws].sum(1), (2.5, 97.5))
    return float(corrected.sum() / bare.sum()), float(low), float(high)


def summary(results: Sequence[Mapping[str, Any]], seed: int = 0) -> dict[str, dict[str, Any]]:
    """By kind of controller: machines, median ratio with its interval over machines, the worst one."""
    found = {}
    for kind in ("lqg", "lqg_hedged", "ppo", "pid"):
        flown = [r for r in results if kind in r["scores"]]
        if not flown:
            continue
        ratios = np.array([cost_ratio(r["scores"][kind])[0] for r in flown])
        draws = np.random.default_rng(seed).integers(0, len(ratios), (_RESAMPLES, len(ratios)))
        worst = int(ratios.argmax())
        found[kind] = {
            "machines": len(ratios),
            "median_ratio": float(np.median(ratios)),
            "ci95": np.percentile(np.median(ratios[draws], axis=1), (2.5, 97.5)).tolist(),
            "worst_ratio": float(ratios[worst]),
            "worst_seed": flown[worst]["seed"],
            "halved": int((ratios <= _HALF).sum()),
            "dearer": int((ratios > _FULL_PRICE).sum()),
        }
    return found


HEADER = ("machine", "hidden", "named", "controller", "bare", "corrected", "ratio (95 %)")


def rows(results: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Every machine and controller in words, under HEADER."""
    return [
        [
            str(r["seed"]), ", ".join(r["hidden"]), ", ".join(r["named"]) or "nothing", kind,
            _words(score["bare"]), _words(score["corrected"]),
            "{:.2f} ({:.2f} to {:.2f})".format(*cost_ratio(score)),
        ]
        for r in results
        for kind, score in r["scores"].items()
    ]  # fmt: skip


NAMES_HEADER = ("machine", "hidden", "not named", "named, not there")


def _names(result: Mapping[str, Any]) -> list[str]:
    """What the diagnosis made of a machine in words, under NAMES_HEADER."""
    hidden, named = result["hidden"], result["named"]
    missed = [effect for effect in hidden if effect not in named]
    false = [effect for effect in named if effect not in hidden]
    return [str(result["seed"]), ", ".join(hidden), ", ".join(missed), ", ".join(false)]


def _words(score: Mapping[str, Any]) -> str:
    lost = "" if score["success_rate"] == 1.0 else f" ({100 * score['success_rate']:.0f} % succeed)"
    return f"{score['mean_cost']:.3g}{lost}"


def in_words(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The summary, one line per kind of controller."""
    return [
        f"{kind.upper()}, {s['machines']} machines: corrected costs {s['median_ratio']:.2f} of bare in "
        f"the median ({s['ci95'][0]:.2f} to {s['ci95'][1]:.2f}), halved on {s['halved']}, "
        f"dearer by more than 5 % on {s['dearer']}; worst {s['worst_ratio']:.2f} "
        f"(machine {s['worst_seed']})"
        for kind, s in found.items()
    ]


def _world_in_words(results: Sequence[Mapping[str, Any]]) -> str:
    world = dict(results[0].get("world", {}))
    task = world.pop("task", "hover")
    return f"{task}, {', '.join(f'{k} {v}' for k, v in world.items()) or 'still air'}"


def machines_page(results: Sequence[Mapping[str, Any]], words: str = "") -> str:
    """The report as HTML text.

    Args:
        results: of `fly_machines`.
        words: what was typed.
    """
    found = summary(results)
    kinds = list(found)
    bars = {
        kind: [cost_ratio(r["scores"][kind])[0] if kind in r["scores"] else None for r in results]
        for kind in kinds
    }
    names = [f"machine {r['seed']}" for r in results]
    title = "cost corrected / bare"
    sections = [
        Section("Ratios", [
            figure(figures.grouped_bars(names, bars, title, log=True), "Below 1: correcting paid"),
            bullets(in_words(found)),
        ]),
        Section("Machines", [
            table(NAMES_HEADER, [_names(r) for r in results]),
        ]),
        Section("Costs", [
            prose(f"Mean cost per step of {_world_in_words(results)}; the share of flights that "
                  "succeed where it is not all."),
            table((HEADER[0], *HEADER[3:]), [[row[0], *row[3:]] for row in rows(results)]),
        ]),
    ]  # fmt: skip
    if words:
        sections.append(Section("How this was computed", [command(words)]))
    return page("What correcting is worth, machine by machine", in_words(found), sections,
                kicker="Controllers")  # fmt: skip
