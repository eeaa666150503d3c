"""The interface of every controller, and how one is made: by name, or from its file."""

import json
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from coax_env.env.actions import Nominal
from coax_env.errors import InputError
from coax_env.model.vehicle import Vehicle
from controllers.feedback import FORMAT, VERSION

KINDS = {
    "lqr": "linear feedback of the exact state (--sensors state); on noisy sensors: lqg",
    "lqi": "feedback of the exact state with integrals of height, heading and position",
    "lqg": "lqi's feedback on a Kalman filter's estimate from noisy sensors",
    "scheduled": "lqg's designs over forward speed, blended: flies fast to targets (mocap)",
    "ppo": "a trained policy on that filter's estimate; shipped: hovers in still air on onboard",
    "ppo_outdoor": "another, added to lqg's feedback: hover, position, waypoints in wind; or mocap",
    "hinf": "H-infinity hover controller on noisy sensors, for lags the model lacks (slycot)",
    "mpc": "lqg's problem with the actions' bounds, planned by OSQP: a yardstick",
    "pid": "cascaded loops on the raw sensors, tuned by hand",
}
"""The controllers by name."""

_CLASSES = {
    "lqr": ("state_feedback", "StateFeedback"),
    "lqi": ("state_feedback", "StateFeedback"),
    "lqg": ("lqr", "LQG"),
    "scheduled": ("schedule", "Schedule"),
    "hinf": ("hinf", "HInfinity"),
    "mpc": ("mpc", "MPC"),
    "pid": ("pid", "PID"),
}


class Controller(Protocol):
    """Anything that flies CoaxHeli-v0, one helicopter or a batch, from observations alone."""

    @property
    def kind(self) -> str:
        """A word for tables, a key of KINDS."""

    @property
    def sensors(self) -> str:
        """The suite it must be given."""

    @property
    def nominal(self) -> tuple[np.ndarray, np.ndarray]:
        """Trim and scale of its actions, for ``nominal=`` of the env."""

    def reset(self, count: int = 1) -> None:
        """Forget the last flight; `count` helicopters are flown next."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Observation (n_obs,) or (count, n_obs) to action (4,) or (count, 4)."""


def make_controller(
    name: str | Path,
    vehicle: str | Vehicle = "lama400d",
    nominal: Nominal = None,
    sensors: str | None = None,
) -> Controller:
    """A controller by a name of KINDS, designed on a vehicle for a suite, or read from a file.

    Args:
        name: a key of KINDS, the path of a controller.json or policy.zip, or a controller of your
            own: ``my.py:NAME`` or a zip of Stable-Baselines3, which run what is in the file.
        vehicle: what it is designed on.
        nominal: vehicle whose trim centres the action, as in the env (default: the bare one).
        sensors: suite to design for (default: ``onboard``, ``mocap`` for ``scheduled``); ``lqi`` is
            given the exact state, the shipped policy of ``ppo`` and a file have suites of their own.
    """
    from controllers import hinf, lqr, mpc, own_controller, pid, policy, schedule, state_feedback

    if (name in ("lqr", "lqi") and sensors == "state") or (name == "lqi" and sensors is None):
        return state_feedback.design(vehicle, nominal, integral=name == "lqi")
    if name == "lqi":
        raise InputError(f"lqi needs sensors 'state', not {sensors!r}: lqg is for noisy ones")
    if name in ("lqr", "lqg"):
        return lqr.design(vehicle, nominal, sensors or "onboard")
    if name == "scheduled":
        return schedule.design(vehicle, nominal, sensors or "mocap")
    if name in ("hinf", "mpc"):
        return (hinf if name == "hinf" else mpc).design(vehicle, nominal, sensors or "onboard")
    if name == "pid":
        return pid.design(vehicle, nominal, sensors or "onboard")
    if name == "ppo":
        return policy.load_policy(policy.SHIPPED, sensors)
    if name == "ppo_outdoor":
        return policy.load_policy(policy.OUTDOOR, sensors)
    if ".py:" in str(name) or own_controller.is_stable_baselines(Path(name)):
        return own_controller.from_file(str(name), vehicle, sensors, nominal)
    if sensors and Path(name).suffix == ".zip":
        return policy.load_policy(name, sensors)
    return load_controller(name)


def load_controller(path: str | Path) -> Controller:
    """Read a controller.json or a policy.zip; nothing in the file is run.

    Raises:
        InputError: no such file, or not one of these.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(
            f"no controller {str(path)!r}: neither a file, nor my.py:NAME, nor {', '.join(KINDS)}"
        )
    if path.suffix == ".zip":
        from controllers.policy import load_policy

        return load_policy(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: not a JSON file ({error})") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{path}: not a controller of this project (format is not {FORMAT!r})")
    if content.get("version") != VERSION or content.get("kind") not in _CLASSES:
        raise InputError(
            f"{path}: version {content.get('version')!r} of kind {content.get('kind')!r} is unknown"
        )
    module, name = _CLASSES[content["kind"]]
    try:
        controller: Any = getattr(import_module(f"controllers.{module}"), name)
        return controller.from_dict(content)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: a field is missing or of the wrong kind ({error})") from error
