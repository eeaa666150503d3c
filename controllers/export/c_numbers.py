"""coax_numbers.h: everything that differs from one controller to the next."""

from collections.abc import Sequence
from dataclasses import asdict
from math import exp

import numpy as np

from coax_env.env import hover
from coax_env.env.period import DT
from coax_env.model.sensors import slow_instruments, suite
from controllers.estimator import WINDUP
from controllers.estimator_design import (
    EstimatorDesign,
    axis_of,
    horizontal_pairs,
    integrated_readings,
    turned_pairs,
)
from controllers.export.c_values import Fields, constant, literal, macro, structure, structures
from controllers.lqr import LQG
from controllers.pid import PID
from controllers.policy import BEYOND, FEATURE_LIMIT, Policy
from controllers.schedule import BRAKING, GATHERING, Schedule
from controllers.target import (
    BLOWN_BACK,
    BUSY,
    BUSY_MEMORY,
    CALM,
    CALM_PLACE,
    NEW_TARGET,
    REACH,
    RETURN,
    TargetView,
)

_ACTIVATIONS = {
    "tanh": "#define ACTIVATION(x) tanhf(x)",
    "relu": "#define ACTIVATION(x) fmaxf(x, 0.0f)",
}
_PID_PLACES = {
    "AT_YAW_RATE": "r", "AT_PITCH_RATE": "q", "AT_ROLL_RATE": "p", "AT_PITCH": "theta",
    "AT_ROLL": "phi", "AT_SPEED_DOWN": "vd",
}  # fmt: skip


def has_target(sensors: str) -> bool:
    """Whether a suite shows the position that a target needs."""
    return TargetView(sensors).places is not None


def observed(sensors: str) -> int:
    """How many numbers an observation has, without the way to a target."""
    own = suite(sensors)
    return len(own) + len(slow_instruments(own))


def lqg_numbers(controller: LQG) -> list[str]:
    """Of a designed LQG."""
    return [*_filter_numbers(controller.estimator, [_point(controller.estimator, controller.gain)])]


def schedule_numbers(controller: Schedule) -> list[str]:
    """Of an LQG at each of some speeds."""
    points = [
        _point(one.estimator, one.gain) | {"state_trim": at, "advance": advance}
        for one, at, advance in zip(
            controller.points, controller.state_trims, controller.advances, strict=True
        )
    ]
    return [
        *_filter_numbers(controller.points[0].estimator, points),
        macro("POINTS", len(points)),
        macro("BRAKING", BRAKING),
        macro("GATHERING", GATHERING),
        # one more, which no index reaches: a schedule of one speed compiles too
        constant("SPEED", np.append(controller.speeds, controller.speeds[-1] + 1.0)),
    ]


def policy_numbers(controller: Policy) -> list[str]:
    """Of a trained policy: its filter, the feedback that it is added to, and its network."""
    design, layers = controller.estimator, controller.network.layers
    lines = _filter_numbers(design, [_point(design, controller.base_gain)])
    lines += [
        macro("LAYERS", len(layers)),
        macro("WIDEST", max(max(weight.shape) for weight, _ in layers)),
        macro("FEATURE_LIMIT", FEATURE_LIMIT),
        macro("BEYOND", len(BEYOND) if has_target(controller.sensors) else 0),
        _ACTIVATIONS[controller.network.activation],
        constant("PER_SCALE", 1.0 / controller.scales),
    ]
    for k, (weight, bias) in enumerate(layers):
        lines += [constant(f"WEIGHT_{k}", weight.ravel()), constant(f"BIAS_{k}", bias)]
    rows = [
        f"    {{{weight.shape[1]}, {weight.shape[0]}, WEIGHT_{k}, BIAS_{k}}}"
        for k, (weight, _) in enumerate(layers)
    ]
    lines.append(
        "typedef struct {\n    int inputs, outputs;\n    const float *weight, *bias;\n} layer;"
    )
    lines.append("static const layer LAYER[LAYERS] = {\n" + ",\n".join(rows) + "\n};")
    return lines


def pid_numbers(controller: PID) -> list[str]:
    """Of the cascade."""
    names = [sensor.name for sensor in suite(controller.sensors)]
    gains = asdict(controller.gains)
    share = 1.0 - exp(-DT / gains.pop("smoothing"))
    return [
        *_common_numbers(controller.sensors, controller.action_trim, controller.action_scale),
        *(macro(place, names.index(name)) for place, name in _PID_PLACES.items()),
        *(macro(f"GAIN_{name.upper()}", float(gain)) for name, gain in gains.items()),
        macro("SMOOTHING_SHARE", share),
        constant("FEEDFORWARD", controller.feedforward),
    ]


def _common_numbers(sensors: str, trim: np.ndarray, scale: np.ndarray) -> list[str]:
    """The period, the actions' meaning, and where the observation has what the target needs."""
    view = TargetView(sensors)
    names = view.names

    def place(*candidates: str) -> int:
        return next((names.index(name) for name in candidates if name in names), -1)

    return [
        f"#define PERIOD {literal(DT)} /* [s] */",
        macro("HOVER_HEIGHT", hover.HEIGHT),
        macro("HEIGHT_SIGN", view.up),
        macro("REACH_PLACE", REACH["place"]),
        macro("REACH_HEIGHT", REACH["height"]),
        macro("REACH_RETURN", RETURN),
        macro("BLOWN_FIRST", BLOWN_BACK[0]),
        macro("BLOWN_LAST", BLOWN_BACK[1]),
        macro("CALM_PLACE", CALM_PLACE),
        macro("CALM_FIRST", CALM[0]),
        macro("CALM_LAST", CALM[1]),
        macro("BUSY_FIRST", BUSY[0]),
        macro("BUSY_LAST", BUSY[1]),
        macro("BUSY_SHARE", DT / BUSY_MEMORY),
        macro("NEW_TARGET", NEW_TARGET),
        macro("REACH_HEADING", REACH["heading"]),
        macro("AT_NORTH", place("pn", "x")),
        macro("AT_EAST", place("pe", "y")),
        macro("AT_HEIGHT", place("h", "z")),
        macro("AT_HEADING", place("psi")),
        macro("AT_SPEED_NORTH", place("vn")),
        macro("AT_SPEED_EAST", place("ve")),
        constant("ACTION_TRIM", trim),
        constant("ACTION_SCALE", scale),
    ]


def _filter_numbers(design: EstimatorDesign, points: Sequence[Fields]) -> list[str]:
    """Of the Kalman filter, and of what is blended by speed."""
    names, states = design.readings, design.states
    integrated = integrated_readings(design)
    if not integrated:
        raise ValueError("a filter without an integral")

    def place(name: str, among: Sequence[str]) -> int:
        return among.index(name) if name in among else -1

    psi = place("psi", names)
    return [
        *_common_numbers(design.sensors, design.action_trim, design.action_scale),
        macro("STATES", len(states)),
        macro("READINGS", len(names)),
        macro("CYCLE", len(design.gains)),
        macro("INTEGRALS", len(integrated)),
        *(macro(f"STATE_{name.upper()}", place(name, states)) for name in ("x", "y", "z", "psi")),
        macro("STATE_R", place("r", states)),
        macro("TURNED_PAIRS", len(turned_pairs(design))),
        constant("TURNED", turned_pairs(design)),
        macro("READ_PSI", psi),
        macro("OBSERVED_PSI", int(design.reading_places[psi]) if psi >= 0 else 0),
        macro("PAIRS", len(horizontal_pairs(design))),
        constant("PAIR", horizontal_pairs(design)),
        constant("PLACE", design.reading_places),
        constant("FLAG", design.flag_places),
        constant("INTEGRATED", np.array([names.index(name) for name in integrated])),
        constant("AXIS", np.array([axis_of(name) for name in integrated])),
        constant("MOST", WINDUP * np.array(list(integrated.values()))),
        constant("FIRST_STATE", design.first_state),
        structure("design_point", points[0]),
        structures("design_point", "POINT", points),
    ]  # fmt: skip


def _point(design: EstimatorDesign, gain: np.ndarray | None) -> dict[str, np.ndarray]:
    """One design's matrices; gains by reading and state, as the filter takes them."""
    offset = design.action_trim - design.command_trim
    n = len(design.states)
    point = {
        "A": design.A, "B": design.B, "C": design.C, "D": design.D,
        "first_gain": design.first_gain.T, "gain": np.swapaxes(design.gains, 1, 2),
        "state_trim": np.zeros(n), "advance": np.zeros(n),
        "reading_trim": design.reading_trim, "offset": offset,
    }  # fmt: skip
    if gain is not None:
        point |= {"feedforward": -offset / design.action_scale, "feedback": gain}
    return point
