"""Several trainings of a policy, and the best of them in simulation.

Trainings with PPO differ by their seeds, as much as those on two models of one machine do. So a policy
for a model is chosen among candidates, by many flights of that model: trainings from nothing and, where
there is a policy already, that one as it is, the same on the model's filter and trim
(policy_transfer.py), and trained on from there. What is kept is never worse, on these flights, than
what there was.
"""

import hashlib
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from coax_env.env.actions import Nominal
from coax_env.errors import InputError
from coax_env.files import write_bytes, write_json
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle, vehicle_toml
from coax_env.workers import each
from controllers import ppo
from controllers.evaluation import evaluate
from controllers.policy import load_policy, save_policy
from controllers.policy_transfer import joined_features, transferred
from controllers.target import TargetView

FLIGHTS = 200
"""Of 20 s, by which candidates are judged: the mean cost of the same flights is then within 1 %."""
SELECTION_SEED = 10_000
"""Seed of the first of these flights, above the seed given."""
START, TRANSFERRED, TRAINED = "start", "transferred", "trained"
"""Candidates that come from a policy: as it is, on the new filter and trim, and trained from there."""


def train_best(
    vehicle: str | Vehicle,
    out: str | Path,
    seeds: Sequence[int],
    start: str | Path | None = None,
    jobs: int = 1,
    backend: str = "loky",
    flights: int = FLIGHTS,
    done: Callable[[str, dict[str, Any]], None] | None = None,
    task: str | Sequence[str] = "hover",
    world: Mapping[str, Any] | None = None,
    **training: Any,
) -> tuple[str, dict[str, dict[str, Any]]]:
    """Train several policies for a vehicle, and keep the best: OUT/policy.zip.

    Every candidate lies in OUT/seed_K, or in a folder of START, TRANSFERRED or TRAINED, with its
    score.json; what has been trained with the same arguments is not trained again.

    Args:
        vehicle: what flies.
        out: folder of the policies.
        seeds: one training from nothing each.
        start: a policy.zip that gives three more candidates; its training has the first of the
            seeds, 0 without any.
        jobs: trainings at once, as in `coax_env.workers.each`.
        backend: where, as in `coax_env.workers.each`.
        flights: by which each is judged, the same for all: success, then mean cost.
        done: called with the name and the score of each candidate.
        task: what they learn, one or several; the first is judged.
        world: arguments of the env in which they learn and are judged, such as ``wind``.
        training: further arguments of `ppo.train`.

    Returns:
        the best one's name, and the scores of all by name.
    """
    vehicle, out, world = load_vehicle(vehicle), Path(out), dict(world or {})
    if not seeds and not start:
        raise InputError("nothing to train: neither a seed nor a policy to start from")
    if isinstance(training.get("nominal"), str | Path):
        training["nominal"] = load_vehicle(training["nominal"])
    wanted: dict[str, dict[str, Any]] = {f"seed_{seed}": {"seed": seed} for seed in seeds}
    if start:
        own = {"start": Path(start).resolve(), "seed": seeds[0] if seeds else 0}
        wanted = {START: own, TRANSFERRED: own, TRAINED: own} | wanted
    training |= {"task": task, **world}
    first = SELECTION_SEED + (seeds[0] if seeds else 0)
    stamps = {
        name: _stamp(name, vehicle, one | training, first, flights) for name, one in wanted.items()
    }
    stored = {name: _stored(out / name, stamp) for name, stamp in stamps.items()}
    scores = {name: score for name, score in stored.items() if score}
    missing = [(name, one) for name, one in wanted.items() if name not in scores]
    for (name, _), content in each(partial(_made, vehicle, training), missing, jobs, backend):
        path = write_bytes(out / name / "policy.zip", content)
        score = score_of(path, vehicle, first, flights, task, world)
        write_json(path.with_name("score.json"), score | {"stamp": stamps[name]})
        scores[name] = score
        if done:
            done(name, score)
    best = min(wanted, key=lambda name: rank(scores[name]))
    write_bytes(out / "policy.zip", (out / best / "policy.zip").read_bytes())
    return best, {name: scores[name] for name in wanted}


def rank(score: Mapping[str, Any]) -> tuple[float, float]:
    """The lower, the better: success first, then mean cost."""
    return -score["success_rate"], score["mean_cost"]


def _stamp(
    name: str, vehicle: Vehicle, training: Mapping[str, Any], first: int, flights: int
) -> str:
    """What tells a candidate's training and flights from others: the digest of all arguments."""
    told = {
        key: vehicle_toml(value) if isinstance(value, Vehicle) else value
        for key, value in training.items()
        if key not in ("command_line", "tensorboard")
    }
    for key in ("start", "resume"):
        if told.get(key):
            told[key] = hashlib.sha256(Path(told[key]).read_bytes()).hexdigest()
    words = [name, vehicle_toml(vehicle), told, first, flights]
    return hashlib.sha256(json.dumps(words, sort_keys=True, default=str).encode()).hexdigest()


def _stored(folder: Path, stamp: str) -> dict[str, Any] | None:
    """The score of a candidate that lies there, made in the same way."""
    path = folder / "score.json"
    if not path.exists() or not (folder / "policy.zip").exists():
        return None
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found if found.pop("stamp", None) == stamp else None


def _made(
    vehicle: Vehicle, training: Mapping[str, Any], candidate: tuple[str, Mapping[str, Any]]
) -> bytes:
    """The policy.zip of a candidate: its name and what it alone has of the arguments of `ppo.train`."""
    name, own = candidate
    if name == START:
        content: bytes = own["start"].read_bytes()
        return content
    with tempfile.TemporaryDirectory(prefix="coax-ppo-") as folder:
        if name == TRANSFERRED:
            return transfer(own["start"], vehicle, folder, training.get("nominal")).read_bytes()
        return ppo.train(vehicle, folder, **{**training, **own}).read_bytes()


def transfer(
    start: str | Path, vehicle: str | Vehicle, out: str | Path, nominal: Nominal = None
) -> Path:
    """A policy on the filter and the trim of another vehicle, without training: OUT/policy.zip.

    Args:
        start: its policy.zip.
        vehicle: whose filter and trim it gets.
        out: folder of the new one.
        nominal: whose trim centres the action, as in the env.
    """
    vehicle, old = load_vehicle(vehicle), load_policy(start)
    sights = [
        ppo.design_sight(vehicle, nominal, name, "none" if sight.base_gain is None else "lqg")
        for name, sight in old.suites.sights.items()
    ]
    kept = ("command", "seed", "steps", "settings", "cost", "reward")
    content = {key: old.content[key] for key in kept if key in old.content}
    return save_policy(
        Path(out) / "policy.zip", transferred(old, sights), sights, joined_features(old, sights),
        content | {"vehicle": vehicle.name, "transferred_from": old.content["vehicle"]},
    )  # fmt: skip


def score_of(
    path: Path,
    vehicle: str | Vehicle,
    seed: int,
    flights: int = FLIGHTS,
    task: str | Sequence[str] = "hover",
    world: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The score of a policy, on the first suite that shows its target.

    Args:
        path: of its policy.zip.
        vehicle: what is flown.
        seed: of the first flight.
        flights: how many.
        task: that is flown, or several: the first.
        world: arguments of the env.
    """
    first = task if isinstance(task, str) else task[0]
    policy = load_policy(path)
    suites = [s for s in policy.suites.sights if first == "hover" or TargetView(s).aims]
    return evaluate(policy.on(suites[0]), vehicle, flights, seed=seed, task=first, **(world or {}))
