"""A trained policy: plain arrays and a description, read and flown without torch.

``policy.zip`` holds two members that anyone's file can be read from without running any code::

    policy.json   what it is, how it was made, and the estimator before it
    weights.npz   the network's arrays, which NumPy reads with pickles forbidden

Beside them `ppo.train` leaves what Stable-Baselines3 needs to go on training (``data``, ``*.pth``):
pickles, which may run anything, opened only by ``train(resume=...)``. A shipped policy has none.

Single noisy observations do not show the velocity, so the policy gets the estimate and the
integrals of controllers/estimator.py, scaled, and of a far target the way beyond the setpoint that the
estimate is relative to. One network may have been trained on several sensor suites, each with its own
estimator: its features go by name, and those that a suite does not have are zero. `Policy.on` gives the
policy for one of its suites.
"""

import io
import json
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError
from coax_env.files import write_bytes
from controllers.estimator import Estimating, Tracker
from controllers.estimator_design import EstimatorDesign, integrated_readings
from controllers.target import TargetView

FORMAT = "coax-policy"
VERSION = 3
DESCRIPTION = "policy.json"
WEIGHTS = "weights.npz"
SHIPPED = Path(__file__).parent / "policies" / "hover.zip"
"""Trained to hover in still air on default sensors; its description has the command."""
OUTDOOR = SHIPPED.with_name("outdoor.zip")
"""Trained in wind to hover and to fly to targets, on the sensors ``onboard`` and ``mocap``."""

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
}
_LARGEST = 16 * 2**20  # bytes of a member that is read; ours have some 200 kB
FEATURE_LIMIT = 10.0
_INTEGRAL_SHARE = 0.25  # of what counts 1 in LQG's cost: a slow drift must show

FEATURE_SCALES = {
    "u": 0.1, "v": 0.1, "w": 0.1, "p": 0.3, "q": 0.3, "r": 0.3,
    "alpha_l": 0.05, "beta_l": 0.05, "alpha_f": 0.05, "beta_f": 0.05,
    "phi": 0.05, "theta": 0.05, "psi": 0.05, "x": 1.0, "y": 1.0, "z": 0.1,
    "swash_lon": 0.1, "swash_lat": 0.1,
}  # fmt: skip
"""Size of an estimate that becomes 1 for the policy, near what a good hover leaves; the rest by the
filter's own figures. Coarser ones take several times longer to learn from."""

BEYOND = {"beyond_forward": 1.0, "beyond_right": 1.0, "beyond_up": 0.5, "beyond_turn": 0.5}
"""The way from the setpoint on to a far target, and the sizes that become 1 [m, m, m, rad]."""
_AS_PLACE = {"vn": "x", "ve": "y"}
"""Readings whose integral stands for a state, where nothing measures that."""


@dataclass
class Network:
    """A multilayer perceptron: layers (weight (out, in), bias (out,)), the last without activation."""

    layers: list[tuple[np.ndarray, np.ndarray]]
    activation: str = "tanh"

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Features (count, in) to outputs (count, out)."""
        activate = ACTIVATIONS[self.activation]
        for weight, bias in self.layers[:-1]:
            features = activate(features @ weight.T + bias)
        weight, bias = self.layers[-1]
        return features @ weight.T + bias


@dataclass
class Policy(Estimating):
    """A trained policy with its estimator: a controller like any other."""

    network: Network  # of the features of this suite
    estimator: EstimatorDesign
    scales: np.ndarray  # (n + i,) of estimates and integrals, then, with a position, BEYOND's
    content: dict[str, Any]  # of policy.json
    base_gain: np.ndarray | None  # (4, n + i) of a linear feedback that its actions are added to
    suites: "Suites"

    kind = "ppo"

    def begin(self) -> None:
        """New flights of `count` helicopters."""
        super().begin()
        self.view = TargetView(self.sensors)

    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to observations (count, n_obs)."""
        self.known = seen(self.tracker, self.view, observations)
        return self.actions_from_estimate(self.known)

    def actions_from_estimate(self, known: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to what is `seen` (count, as many as scales)."""
        actions = self.network(features(known, self.scales))
        if self.base_gain is None:
            return actions
        return actions + linear_actions(self.tracker, self.base_gain, known)

    def on(self, sensors: str) -> "Policy":
        """This policy for another of the suites that it was trained on.

        Raises:
            InputError: it was not trained on that one.
        """
        if sensors not in self.suites.sights:
            known = ", ".join(self.suites.sights)
            raise InputError(f"this policy was trained on sensors {known}, not on {sensors!r}")
        return _for_suite(self.suites, sensors, self.content)


@dataclass(frozen=True)
class Sight:
    """What a policy flies one sensor suite with: the filter, and the linear feedback of LQG's form."""

    estimator: EstimatorDesign
    base_gain: np.ndarray | None = None  # (4, n + i)


@dataclass(frozen=True)
class Suites:
    """What a policy has for all the suites that it was trained on."""

    network: Network  # of the features of all
    sights: dict[str, Sight]  # by suite


def linear_actions(tracker: Tracker, gain: np.ndarray, known: np.ndarray) -> np.ndarray:
    """LQG's actions (count, 4) to what is `seen` (count, n + i or more), not yet clipped.

    Args:
        tracker: design and estimate. gain: (4, n + i). known: what is `seen`.
    """
    feedforward = -tracker.offset / tracker.design.action_scale
    return feedforward - known[:, : gain.shape[1]] @ gain.T


def seen(
    tracker: Tracker, view: TargetView, observations: np.ndarray, which: np.ndarray | None = None
) -> np.ndarray:
    """What the features are made of, (count, as many as `feature_sizes`); arguments as Tracker.see."""
    known = tracker.see(observations, which)
    return np.hstack([known, view.beyond(observations)]) if view.aims else known


def features(known: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """What is `seen` (count, n) in units of its scales, float32, within [-10, 10]."""
    found = (known * (1.0 / scales)).astype(np.float32)
    return np.clip(found, -FEATURE_LIMIT, FEATURE_LIMIT, out=found)


def feature_sizes(design: EstimatorDesign) -> dict[str, float]:
    """Name of everything `seen`, in order, and the size that becomes 1 in its feature.

    The integral of a velocity stands for the place where that is not measured, and has its name.
    """
    found = {}
    for name, spread in zip(design.states, design.spread, strict=True):
        if name.startswith("omega_"):
            found[name] = float(design.action_scale[0 if name == "omega_u" else 1])
        else:
            found[name] = FEATURE_SCALES.get(name, max(3.0 * float(spread), 1e-6))
    for name, size in integrated_readings(design).items():
        found[_AS_PLACE.get(name, f"sum_{name}")] = _INTEGRAL_SHARE * size
    return found | (BEYOND if TargetView(design.sensors).aims else {})


def all_features(designs: Iterable[EstimatorDesign]) -> dict[str, float]:
    """Name and size of every feature of a network for several suites; the first's sizes count."""
    found: dict[str, float] = {}
    for design in designs:
        found = found | {k: v for k, v in feature_sizes(design).items() if k not in found}
    return found


def save_policy(
    path: str | Path,
    network: Network,
    sights: Sequence["Sight"],
    sizes: Mapping[str, float],
    content: dict[str, Any],
    training: bytes = b"",
) -> Path:
    """Write policy.zip whole or not at all.

    Args:
        path: where to.
        network: its input are the features.
        sights: the estimators whose estimates they are made of, one per suite.
        sizes: of the features by name, see `all_features`.
        content: further entries of the description.
        training: a zip file of Stable-Baselines3, whose members join the plain ones.
    """
    arrays: dict[str, Any] = {}
    for k, (weight, bias) in enumerate(network.layers):
        arrays[f"weight_{k}"], arrays[f"bias_{k}"] = weight, bias
    weights, buffer = io.BytesIO(), io.BytesIO(training)
    np.savez(weights, **arrays)
    content = {
        **content,
        "format": FORMAT, "version": VERSION, "kind": Policy.kind,
        "activation": network.activation,
        "features": dict(sizes),
        "estimators": [sight.estimator.to_dict() for sight in sights],
        "base_gains": [None if s.base_gain is None else s.base_gain.tolist() for s in sights],
    }  # fmt: skip
    with zipfile.ZipFile(buffer, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(_undated(DESCRIPTION), json.dumps(content, allow_nan=False))
        archive.writestr(_undated(WEIGHTS), weights.getvalue())
    return write_bytes(path, buffer.getvalue())


def _undated(name: str) -> zipfile.ZipInfo:
    """A member without a date: the same policy makes the same file."""
    member = zipfile.ZipInfo(name)
    member.compress_type = zipfile.ZIP_DEFLATED
    return member


def load_policy(path: str | Path, sensors: str | None = None) -> Policy:
    """Read the plain members of a policy.zip; nothing in the file is run.

    Args:
        path: of the file.
        sensors: one of the suites it was trained on; None: the first.

    Raises:
        InputError: no such file, or not a policy of this project.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no policy {str(path)!r}")
    try:
        with zipfile.ZipFile(path) as archive:
            content = json.loads(_member(archive, DESCRIPTION))
            weights = _member(archive, WEIGHTS)
        if content.get("format") != FORMAT or content.get("version") != VERSION:
            raise InputError(f"{path}: version {content.get('version')!r} of a policy is unknown")
        sights = _sights(content["estimators"], content["base_gains"])
        sizes = np.array(list(content["features"].values()), dtype=float)
        if not (np.isfinite(sizes) & (sizes > 0.0)).all():
            raise ValueError("a feature has no size")
        network = _network(weights, content["activation"], len(sizes))
        suites = Suites(network, {sight.estimator.sensors: sight for sight in sights})
        policies = [_for_suite(suites, name, content) for name in suites.sights]
    except InputError:
        raise
    except (
        OSError, KeyError, ValueError, TypeError, AttributeError, EOFError, RecursionError,
        NotImplementedError, RuntimeError, MemoryError, IndexError, zipfile.BadZipFile, zlib.error,
    ) as error:  # fmt: skip
        raise InputError(f"{path}: not a policy of this project") from error
    return policies[0] if sensors is None else policies[0].on(sensors)


def _sights(estimators: list[Any], gains: list[Any]) -> list[Sight]:
    """Sights of a description, their shapes checked."""
    found = []
    for one, gain in zip(estimators, gains, strict=True):
        design = EstimatorDesign.from_dict(one)
        known = len(design.states) + len(integrated_readings(design))
        matrix = None if gain is None else np.array(gain, dtype=float)
        if matrix is not None and (matrix.shape != (4, known) or not np.isfinite(matrix).all()):
            raise ValueError(f"a gain has shape {matrix.shape}")
        found.append(Sight(design, matrix))
    return found


def _for_suite(suites: Suites, sensors: str, content: dict[str, Any]) -> Policy:
    """The policy for one suite: the features that it does not have are zero, and left out."""
    sizes, sight = content["features"], suites.sights[sensors]
    names = list(feature_sizes(sight.estimator))
    places = [list(sizes).index(name) for name in names]
    (weight, bias), *others = suites.network.layers
    layers = [(np.ascontiguousarray(weight[:, places]), bias), *others]
    own = replace(suites.network, layers=layers)
    scales = np.array([float(sizes[name]) for name in names])
    return Policy(own, sight.estimator, scales, content, sight.base_gain, suites)


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    if archive.getinfo(name).file_size > _LARGEST:
        raise ValueError(f"{name} is too large")
    return archive.read(name)


def _network(weights: bytes, activation: str, width: int) -> Network:
    """The network of weights.npz, its shapes checked against `width` features and four actions."""
    if activation not in ACTIVATIONS:
        raise ValueError(f"unknown activation {activation!r}")
    with zipfile.ZipFile(io.BytesIO(weights)) as members:
        if sum(member.file_size for member in members.infolist()) > _LARGEST:
            raise ValueError(f"{WEIGHTS} is too large")
    layers = []
    with np.load(io.BytesIO(weights), allow_pickle=False) as arrays:
        for k in range(len(arrays.files) // 2):
            weight, bias = arrays[f"weight_{k}"], arrays[f"bias_{k}"]
            if weight.shape != (len(bias), width) or not np.isfinite(weight).all():
                raise ValueError(f"layer {k} has shape {weight.shape}")
            layers.append((weight.astype(np.float32), bias.astype(np.float32)))
            width = len(bias)
    if not layers or width != 4:
        raise ValueError("the last layer must have four outputs")
    return Network(layers, activation)
