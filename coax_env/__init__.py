"""coax: a Gymnasium environment and controller design workbench for a micro coaxial helicopter.

One compiled model of the flight dynamics (dynamics.py) stands in the middle::

    vehicles/*.toml -> vehicle -> dynamics (+ effects) -> sensors -> env -> controllers -> scripts
    flight folder -> flight -> engine (innovations, likelihood) -> identification -> vehicle file
    flight + model -> innovations -> signatures -> diagnosis -> corrected vehicle -> gain, report
    two flights -> one model of both -> comparison: what changed; many flights -> logbook

The names below are imported when first used, so that ``import coax_env`` is light and works without
torch, plotly and control. Importing it registers ``CoaxHeli-v0`` with Gymnasium.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from coax_env.errors import InputError

if TYPE_CHECKING:
    from coax_env.comparison.compare import compare
    from coax_env.comparison.logbook import logbook
    from coax_env.diagnosis.diagnose import diagnose
    from coax_env.estimation.prediction import replay
    from coax_env.identification.identify import identify
    from coax_env.logs.flight import read_flight, write_flight
    from coax_env.model.dynamics import derivative, hover_trim
    from coax_env.model.linear import linearize
    from coax_env.model.trim import trim
    from coax_env.model.user_effects import load_effect
    from coax_env.model.vehicle import Vehicle
    from coax_env.model.vehicle_file import load_vehicle
    from coax_env.simulation.simulate import simulate

__version__ = "0.1.0"

_HOME = {
    "Vehicle": "model.vehicle",
    "load_vehicle": "model.vehicle_file",
    "load_effect": "model.user_effects",
    "derivative": "model.dynamics",
    "hover_trim": "model.dynamics",
    "linearize": "model.linear",
    "trim": "model.trim",
    "read_flight": "logs.flight",
    "write_flight": "logs.flight",
    "simulate": "simulation.simulate",
    "replay": "estimation.prediction",
    "identify": "identification.identify",
    "diagnose": "diagnosis.diagnose",
    "compare": "comparison.compare",
    "logbook": "comparison.logbook",
}

__all__ = [
    "InputError",
    "Vehicle",
    "compare",
    "derivative",
    "diagnose",
    "hover_trim",
    "identify",
    "linearize",
    "load_effect",
    "load_vehicle",
    "logbook",
    "read_flight",
    "replay",
    "simulate",
    "trim",
    "write_flight",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"coax_env.{_HOME[name]}"), name)


def _register() -> None:
    from gymnasium.envs.registration import register, registry

    if "CoaxHeli-v0" not in registry:
        register(
            id="CoaxHeli-v0",
            entry_point="coax_env.env.gym_env:CoaxEnv",
            vector_entry_point="coax_env.env.vector_env:CoaxVectorEnv",
            max_episode_steps=2000,
        )


_register()
