"""A controller as C99 files: its interface, its numbers, its code, and a program that times it."""

from collections.abc import Callable
from importlib.resources import files
from typing import Any

from coax_env.errors import InputError
from controllers.export import c_numbers
from controllers.export.interface import header
from controllers.lqr import LQG
from controllers.pid import PID
from controllers.policy import Policy
from controllers.schedule import Schedule

_IGNORED = "A reading that is no finite number carries no information and changes nothing."
_HELD = "A reading that is no finite number is taken for the last one that was."
_FILTER_MEMBERS = (
    "float state[{n}]; /* the estimate */",
    "float integral[{i}];",
    "float action[COAX_COMMANDS]; /* the last one */",
    "float asked[4]; /* the setpoint: x y z psi */",
    "float speed; /* asked for [m/s] */",
    "float nearest, last; /* distances from the target [m] */",
    "float plate; /* its smoothed use, of its range */",
    "int row; /* of the sensors' cycle */",
    "int periods; /* since the start, counted until the setpoint's reach is whole */",
)
_PID_MEMBERS = (
    "float smooth[3]; /* forward, right, down [m/s] */",
    "float sum[4];",
    "float asked[4]; /* the setpoint: x y z psi */",
    "float last[COAX_OBSERVED]; /* readings that were numbers */",
)
_FLOAT = 4  # bytes


def c_files(controller: Any) -> dict[str, str]:
    """File name -> text, of a controller that can be exported.

    Raises:
        InputError: a kind that has no C code.
    """
    kinds: dict[type, Callable[[Any], tuple[list[str], list[str]]]] = {
        LQG: lambda c: (
            c_numbers.lqg_numbers(c), ["filter", "one_point", "feedback", "linear", "step"],
        ),
        Schedule: lambda c: (
            c_numbers.schedule_numbers(c), ["filter", "schedule", "feedback", "linear", "step"],
        ),
        Policy: lambda c: (
            c_numbers.policy_numbers(c), ["filter", "one_point", _base(c), "network", "step"],
        ),
        PID: lambda c: (c_numbers.pid_numbers(c), ["pid"]),
    }  # fmt: skip
    if type(controller) not in kinds:
        raise InputError(
            f"a controller of kind {controller.kind!r} cannot be exported: "
            "lqg, scheduled, ppo, ppo_outdoor and pid can"
        )
    numbers, parts = kinds[type(controller)](controller)
    target = c_numbers.has_target(controller.sensors)
    parts = ["head", "target" if target else "no_target", *parts]
    top = [
        "/* Written by scripts/export.py. */",
        "#ifndef COAX_NUMBERS_H",
        "#define COAX_NUMBERS_H",
    ]
    return {
        "coax_controller.h": _header(controller, target),
        "coax_numbers.h": "\n".join([*top, *numbers, "#endif", ""]),
        "coax_controller.c": "".join(_part(name) for name in parts),
        "step_time.c": _part("step_time"),
    }  # fmt: skip


def _base(policy: Policy) -> str:
    """The part that a policy's outputs are added to."""
    return "no_feedback" if policy.base_gain is None else "feedback"


def _part(name: str) -> str:
    return (files("controllers.export") / "c" / f"{name}.c").read_text(encoding="utf-8")


def _header(controller: Any, target: bool) -> str:
    """coax_controller.h of a controller."""
    observed = c_numbers.observed(controller.sensors)
    if isinstance(controller, PID):
        members, note, stack = list(_PID_MEMBERS), _HELD, 4 * observed
    else:
        scheduled = isinstance(controller, Schedule)
        design = controller.points[0].estimator if scheduled else controller.estimator
        n, m = len(design.states), len(design.readings)
        i = len(c_numbers.integrated_readings(design))
        members = [member.format(n=n, i=i) for member in _FILTER_MEMBERS]
        note, stack = _IGNORED, observed + 3 * m + 3 * n
        if isinstance(controller, Policy):
            stack += 2 * max(max(weight.shape) for weight, _ in controller.network.layers)
    title = (
        f"{controller.kind.upper()} for {_designed_on(controller)}, sensors {controller.sensors}."
    )
    filtered = not isinstance(controller, PID)
    return header(title, controller.sensors, members, note, _FLOAT * stack, target, filtered)


def _designed_on(controller: Any) -> str:
    """The vehicle that it was made for, by name."""
    name = getattr(controller, "vehicle", None) or controller.content.get("vehicle", "a vehicle")
    return str(name).replace("*/", "")
