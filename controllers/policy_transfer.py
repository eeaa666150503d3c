"""A policy on another model: its network, fed with that model's estimate, about that model's trim.

What a network has learnt is a feedback on deviations from hover. The filter and the trim are the
model's: where it is corrected both are taken from it at once, without any training. Features go by
name: those that the policy has keep their size, and those that it lacks, such as a place that its
sensors did not measure, enter the first layer with weight zero.
"""

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError, require
from controllers.policy import Network, Policy, Sight, all_features

_TRAINED = "policy.pth"  # Stable-Baselines3's arrays: read without running anything
_ACTOR = ("mlp_extractor.policy_net.", "action_net.")


def joined_features(old: Policy | None, sights: Sequence[Sight]) -> dict[str, float]:
    """Name and size of every feature: those of a policy first, then those that it lacks.

    Args:
        old: the policy, if any.
        sights: what is flown with.
    """
    known = dict(old.content["features"]) if old else {}
    own = all_features(sight.estimator for sight in sights)
    return known | {name: size for name, size in own.items() if name not in known}


def transferred(old: Policy, sights: Sequence[Sight]) -> Network:
    """The network of a policy, of the `joined_features`, with the trim of another model.

    Args:
        old: the policy.
        sights: what it will be flown with.
    """
    network = old.suites.network
    (first, bias), *others = network.layers
    layers = [(_widened(first, len(joined_features(old, sights))), bias), *others]
    weight, bias = layers[-1]
    before = next(iter(old.suites.sights.values()))
    moved = (_feedforward(sights[0]) - _feedforward(before)).astype(np.float32)
    return Network([*layers[:-1], (weight, bias + moved)], network.activation)


def _feedforward(sight: Sight) -> np.ndarray:
    """The action (4,) of the model's trim; zero where a linear feedback adds it."""
    if sight.base_gain is not None:
        return np.zeros(4)
    design = sight.estimator
    return (design.command_trim - design.action_trim) / design.action_scale


def _widened(weight: np.ndarray, width: int) -> np.ndarray:
    """A weight (out, in) with zeros for further inputs: (out, width); a bias as it is."""
    if weight.ndim < 2:
        return weight
    return np.pad(weight, ((0, 0), (0, width - weight.shape[1])))


def begin_from(model: Any, network: Network, path: str | Path) -> None:
    """Let training begin with a network, and with the critic and the noise of the policy it is from.

    Args:
        model: of Stable-Baselines3, for the network's features.
        network: `transferred`.
        path: of the policy's file; where it holds the plain arrays only, the critic begins anew.

    Raises:
        InputError: the networks have another shape than the model's, or the file is broken.
    """
    torch = require("torch", "rl")
    state = model.policy.state_dict()
    actor = [name for name in state if name.startswith(_ACTOR)]
    flat = [array for layer in network.layers for array in layer]
    stored = _stored(path)
    try:
        arrays = dict(zip(actor, flat, strict=True))
        for name in stored.keys() - set(actor):
            arrays[name] = _widened(stored[name], state[name].shape[-1])
        model.policy.load_state_dict(
            state | {name: torch.as_tensor(array) for name, array in arrays.items()}
        )
    except (ValueError, RuntimeError, KeyError) as error:
        raise InputError(f"{path}: its networks do not fit these settings") from error


def _stored(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays that Stable-Baselines3 trained, by name; none where the file is without them."""
    torch = require("torch", "rl")
    with zipfile.ZipFile(path) as archive:
        if _TRAINED not in archive.namelist():
            return {}
        content = io.BytesIO(archive.read(_TRAINED))
    try:
        stored = torch.load(content, map_location="cpu", weights_only=True)
        return {name: array.numpy() for name, array in stored.items()}
    except Exception as error:  # torch raises of every kind
        raise InputError(f"{path}: {_TRAINED} is broken") from error
