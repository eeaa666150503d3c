"""A controller of your own, flown and scored as the shipped ones are.

A function of one observation, a class with ``act``, a model of Stable-Baselines3 or a python-control
system becomes a `Controller` (`as_controller`); ``my.py:NAME`` and another's ``.zip`` do from the
command line (`from_file`).
"""

import copy
import importlib.util
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.env.actions import Nominal, action_map, nominal_for
from coax_env.env.hover import CONTROL_PERIOD
from coax_env.env.spaces import ACTIONS
from coax_env.errors import InputError
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers.estimator_design import design_estimator
from controllers.feedback import Feedback

DEFAULT_SENSORS = "onboard"
_SB3_DATA = "data"  # the member of a Stable-Baselines3 zip that says what it is
_LARGEST = 16 * 2**20  # bytes of that member that are read


def as_controller(
    source: Any,
    vehicle: str | Vehicle = "lama400d",
    sensors: str | None = None,
    nominal: Nominal = None,
) -> Any:
    """Whatever flies, as a `controllers.Controller`; one that already is comes back as it is.

    Args:
        source: one of

            - a function: observation (n_obs,) -> action (4,), within [-1, 1];
            - a class, made anew for every helicopter, or an object, copied for every one, with
              ``act(observation) -> action`` and, if it has a memory, ``reset()``;
            - a model of Stable-Baselines3, or anything with its ``predict``, recurrent ones too;
            - a ``control.StateSpace`` or transfer function. Its inputs are readings by their names
              in the observation (without names: the first ones), its outputs the commands by
              theirs (without: omega_u, omega_l, delta_lon, delta_lat), both SI and as deviations
              from the hover trim of the nominal vehicle, as in `coax_env.linearize`. A continuous
              one is sampled at the env's rate (Tustin).
        vehicle: what it will fly, which says the nominal one.
        sensors: suite that it is given; default its own attribute ``sensors``, else ``onboard``.
        nominal: vehicle whose trim centres its actions, as in the env.

    Raises:
        InputError: it is none of these, or its signals are not the env's.
    """
    import control

    if all(hasattr(source, name) for name in ("kind", "sensors", "nominal", "act", "reset")):
        return source
    sensors = sensors or getattr(source, "sensors", None) or DEFAULT_SENSORS
    vehicle = load_vehicle(vehicle)
    scaling = action_map(vehicle, nominal)
    if isinstance(source, control.lti.LTI):
        return LinearSystem(source, nominal_for(vehicle), sensors, scaling)
    if hasattr(source, "predict") and not isinstance(source, type):
        return Model(source, sensors, scaling)
    if isinstance(source, type):
        return OnePerHelicopter(source, source.__name__, sensors, scaling)
    if hasattr(source, "act"):
        copies = lambda: copy.deepcopy(source)  # noqa: E731
        return OnePerHelicopter(copies, type(source).__name__, sensors, scaling)
    if callable(source):
        name = getattr(source, "__name__", type(source).__name__)
        return OnePerHelicopter(lambda: source, name, sensors, scaling)
    raise InputError(
        f"a controller is a function, a class with act, a model with predict or a python-control"
        f" system, not {type(source).__name__}"
    )


class _Own(Feedback):
    """What somebody else's controller has in common with ours: a suite, and what an action means."""

    def __init__(self, name: str, sensors: str, scaling: tuple[np.ndarray, np.ndarray]) -> None:
        self.kind, self.sensors = name, sensors
        self.action_trim, self.action_scale = scaling

    def checked(self, actions: Any) -> np.ndarray:
        """Actions as (count, 4) numbers."""
        found = np.asarray(actions, dtype=float)
        if found.shape != (self.count, len(ACTIONS)):
            each = found.shape[1:] if found.ndim and len(found) == self.count else found.shape
            raise InputError(f"{self.kind} gives an action of shape {each}, not ({len(ACTIONS)},)")
        return found


class OnePerHelicopter(_Own):
    """Functions and objects that see one helicopter at a time."""

    def __init__(
        self,
        make: Callable[[], Any],
        name: str,
        sensors: str,
        scaling: tuple[np.ndarray, np.ndarray],
    ) -> None:
        super().__init__(name, sensors, scaling)
        self._make = make

    def begin(self) -> None:
        """New flights of `count` helicopters."""
        pilots = [self._make() for _ in range(self.count)]
        for pilot in pilots:
            if hasattr(pilot, "reset"):
                pilot.reset()
        self._acts = [getattr(pilot, "act", pilot) for pilot in pilots]

    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4) to observations (count, n_obs)."""
        pairs = zip(self._acts, observations, strict=True)
        return self.checked([np.ravel(act(observation)) for act, observation in pairs])


class Model(_Own):
    """A model of Stable-Baselines3: its ``predict``, deterministic; a recurrent one keeps its state."""

    def __init__(self, model: Any, sensors: str, scaling: tuple[np.ndarray, np.ndarray]) -> None:
        super().__init__(type(model).__name__, sensors, scaling)
        self.model = model

    def begin(self) -> None:
        """New flights of `count` helicopters."""
        self._memory: Any = None
        self._first = np.ones(self.count, dtype=bool)

    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4) to observations (count, n_obs)."""
        try:
            actions, self._memory = self.model.predict(
                observations, state=self._memory, episode_start=self._first, deterministic=True
            )
        except ValueError as error:  # Stable-Baselines3: another shape of observation
            raise InputError(
                f"{self.kind} was not trained on {self.sensors!r} sensors of this task ({error})"
            ) from error
        self._first = np.zeros(self.count, dtype=bool)
        return self.checked(actions)


class LinearSystem(_Own):
    """A python-control system: deviations of readings in, deviations of commands out."""

    def __init__(
        self,
        system: Any,
        vehicle: Vehicle,
        sensors: str,
        scaling: tuple[np.ndarray, np.ndarray],
    ) -> None:
        super().__init__(system.name or "system", sensors, scaling)
        model = design_estimator(vehicle, vehicle, sensors)  # for names and trim of the readings
        self._places = _places(system.input_labels, model.readings, "input", "u")
        commands = tuple(command.name for command in ACTIONS)
        self._commands = _places(system.output_labels, commands, "output", "y")
        if len(self._commands) != len(commands):
            raise InputError(f"a controller needs the outputs {', '.join(commands)}")
        self._reading_trim = model.reading_trim[self._places]
        self._feedforward = (model.command_trim - self.action_trim) / self.action_scale
        self._system = _sampled(system)

    def begin(self) -> None:
        """New flights of `count` helicopters."""
        self._state = np.zeros((self.count, self._system.nstates))

    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4) to observations (count, n_obs)."""
        seen = observations[:, self._places] - self._reading_trim
        system = self._system
        commands = np.empty((self.count, len(ACTIONS)))
        commands[:, self._commands] = self._state @ system.C.T + seen @ system.D.T
        self._state = self._state @ system.A.T + seen @ system.B.T
        return self._feedforward + commands / self.action_scale


def _places(labels: list[str], known: tuple[str, ...], what: str, unnamed: str) -> list[int]:
    """Where signals of a system are among those known, by name, or in order where they have none."""
    if list(labels) == [f"{unnamed}[{k}]" for k in range(len(labels))] and len(labels) <= len(
        known
    ):
        return list(range(len(labels)))
    for label in labels:
        if label not in known:
            raise InputError(f"the system's {what} {label!r} is none of {', '.join(known)}")
    return [known.index(label) for label in labels]


def _sampled(system: Any) -> Any:
    """A system as a discrete state space at the env's rate."""
    import control

    system = control.ss(system)
    if system.nstates and system.isctime(strict=True):
        return control.sample_system(system, CONTROL_PERIOD, method="tustin")
    period = system.dt
    if system.nstates and period not in (None, True) and abs(period - CONTROL_PERIOD) > 1e-9:
        raise InputError(f"the system's period is {period:g} s, the env's {CONTROL_PERIOD:g} s")
    return system


def from_file(
    source: str, vehicle: str | Vehicle, sensors: str | None, nominal: Nominal = None
) -> Any:
    """``my.py:NAME`` or a zip of Stable-Baselines3, as a controller. Both run what is in the file.

    Args:
        source: the words. vehicle: that it is to fly. sensors: suite, None: the default.
        nominal: of the actions.

    Raises:
        InputError: no such file or name, an error while it is run, or not a controller.
    """
    if source.endswith(".zip"):
        return as_controller(_stable_baselines_model(Path(source)), vehicle, sensors, nominal)
    path, _, name = source.rpartition(":")
    spec = importlib.util.spec_from_file_location(Path(path).stem, path)
    if spec is None or spec.loader is None or not Path(path).is_file():
        raise InputError(f"no Python file {path!r}")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"{path}: {type(error).__name__} while it was run: {error}") from error
    if not hasattr(module, name):
        raise InputError(f"{path} has no {name!r}")
    return as_controller(getattr(module, name), vehicle, sensors, nominal)


def is_stable_baselines(path: Path) -> bool:
    """Whether a zip was saved by Stable-Baselines3 and is none of this project's policies."""
    from controllers.policy import DESCRIPTION

    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False
    return _SB3_DATA in names and DESCRIPTION not in names


def _stable_baselines_model(path: Path) -> Any:
    """The model of a zip, by the class that its own description fits; its pickles are run.

    The zip does not name its algorithm. Its policy's module does for off-policy ones; of the on-policy
    ones only PPO has a clip range, only the recurrent one a recurrent policy.
    """
    with zipfile.ZipFile(path) as archive:
        if archive.getinfo(_SB3_DATA).file_size > _LARGEST:
            raise InputError(f"{path}: its description is too large")
        data = json.loads(archive.read(_SB3_DATA))
    module = str(data.get("policy_class", {}).get("__module__", ""))
    word = module.split(".")
    try:
        if word[0] == "sb3_contrib":
            import sb3_contrib as library

            by_module = {"recurrent": "RecurrentPPO", "tqc": "TQC", "ars": "ARS"}
            known = next((name for part, name in by_module.items() if part in module), "TRPO")
        else:
            import stable_baselines3 as library

            by_module = {"sac": "SAC", "td3": "TD3", "dqn": "DQN"}
            known = by_module.get(word[1] if len(word) > 1 else "", "")
            known = known or ("PPO" if "clip_range" in data else "A2C")
        return getattr(library, known).load(path, device="cpu")
    except ImportError as error:
        raise InputError(f"{path}: needs {error.name}: pip install 'coaxheli[rl]'") from error
    except Exception as error:
        raise InputError(f"{path}: Stable-Baselines3 cannot load it ({error})") from error
