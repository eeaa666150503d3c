"""A trained policy: plain arrays and a description, read and flown without torch.

``policy.zip`` holds two members that anyone's file can be read from without running any code::

    policy.json   what it is, how it was made, and the estimator before it
    weights.npz   the network's arrays, which NumPy reads with pickles forbidden

Beside them `ppo.train` leaves what Stable-Baselines3 needs to go on training (``data``, ``*.pth``):
pickles, which may run anything, opened only by ``train(resume=...)``. A shipped policy has none.

Single noisy observations do not show the velocity, so the policy gets the estimate and the
integrals of controllers/estimator.py, scaled.
"""

import io
import json
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError
from coax_env.files import write_bytes
from controllers.estimator import Estimating, EstimatorDesign, integrated_readings

FORMAT = "coax-policy"
VERSION = 2
DESCRIPTION = "policy.json"
WEIGHTS = "weights.npz"
SHIPPED = Path(__file__).parent / "policies" / "hover.zip"
"""Trained on vehicles drawn from lama400d, default sensors; its description has the command."""

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
}
_LARGEST = 16 * 2**20  # bytes of a member that is read; ours have some 200 kB
_FEATURE_LIMIT = 10.0
_INTEGRAL_SHARE = 0.25  # of what counts 1 in LQG's cost: a slow drift must show

FEATURE_SCALES = {
    "u": 0.1, "v": 0.1, "w": 0.1, "p": 0.3, "q": 0.3, "r": 0.3,
    "alpha_l": 0.05, "beta_l": 0.05, "alpha_f": 0.05, "beta_f": 0.05,
    "phi": 0.05, "theta": 0.05, "psi": 0.05, "x": 1.0, "y": 1.0, "z": 0.1,
    "swash_lon": 0.1, "swash_lat": 0.1,
}  # fmt: skip
"""Size of an estimate that becomes 1 for the policy, near what a good hover leaves; the rest by the
filter's own figures. Coarser ones take several times longer to learn from."""


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

    network: Network
    estimator: EstimatorDesign
    scales: np.ndarray  # (n + i,), of estimates and integrals
    content: dict[str, Any]  # of policy.json

    kind = "ppo"

    def actions_from_estimate(self, known: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to estimates and integrals (count, n + i)."""
        return self.network(features(known, self.scales))


def features(known: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Estimates and integrals (count, n + i) in units of their scales, float32, within [-10, 10]."""
    found = (known * (1.0 / scales)).astype(np.float32)
    return np.clip(found, -_FEATURE_LIMIT, _FEATURE_LIMIT, out=found)


def feature_scales(design: EstimatorDesign) -> np.ndarray:
    """Size of an estimate or integral that becomes 1 in its feature, (n + i,)."""
    sizes = []
    for name, spread in zip(design.states, design.spread, strict=True):
        if name.startswith("omega_"):
            sizes.append(float(design.action_scale[0 if name == "omega_u" else 1]))
        else:
            sizes.append(FEATURE_SCALES.get(name, max(3.0 * float(spread), 1e-6)))
    integrals = [_INTEGRAL_SHARE * size for size in integrated_readings(design).values()]
    return np.array(sizes + integrals)


def n_features(design: EstimatorDesign) -> int:
    """Number of features: estimate and integrals."""
    return len(design.states) + len(integrated_readings(design))


def save_policy(
    path: str | Path,
    network: Network,
    design: EstimatorDesign,
    scales: np.ndarray,
    content: dict[str, Any],
    training: bytes = b"",
) -> Path:
    """Write policy.zip whole or not at all.

    Args:
        path: where to.
        network: its input are the features.
        design: the estimator whose estimate they are made of.
        scales: of the features, (n + i,).
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
        "feature_scales": scales.tolist(),
        "estimator": design.to_dict(),
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


def load_policy(path: str | Path) -> Policy:
    """Read the plain members of a policy.zip; nothing in the file is run.

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
        design = EstimatorDesign.from_dict(content["estimator"])
        scales = np.array(content["feature_scales"], dtype=float)
        if scales.shape != (n_features(design),) or not (scales > 0.0).all():
            raise ValueError("feature_scales do not fit the estimator")
        network = _network(weights, content["activation"], n_features(design))
    except InputError:
        raise
    except (
        OSError, KeyError, ValueError, TypeError, AttributeError, EOFError, RecursionError,
        NotImplementedError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error,
    ) as error:  # fmt: skip
        raise InputError(f"{path}: not a policy of this project") from error
    return Policy(network, design, scales, content)


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
