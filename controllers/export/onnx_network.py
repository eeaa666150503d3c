"""A policy's network, and its linear feedback where it has one, as ONNX: what the Kalman filter knows
in, actions out.

The filter has a memory and is not in it: it stays C or Python. Needs the package ``onnx``.
"""

import numpy as np

from controllers.estimator_design import integrated_readings
from controllers.policy import BEYOND, FEATURE_LIMIT, Policy
from controllers.target import TargetView

_OPSET = 17
_IR_VERSION = 8  # of ONNX 1.13: readers of 2023 and later
_OPERATORS = {"tanh": "Tanh", "relu": "Relu"}


def onnx_bytes(policy: Policy) -> bytes:
    """An ONNX model: ``known`` (n, k), SI, to ``action`` (n, 4) within -1 .. 1.

    What is known are states and integrals and, on sensors that show a target, the way from the
    setpoint on to it; the model's property ``known`` names them.
    """
    from onnx import TensorProto, helper, numpy_helper

    design = policy.estimator
    constants = {
        "per_scale": (1.0 / policy.scales).astype(np.float32),
        "feature_low": np.float32(-FEATURE_LIMIT), "feature_high": np.float32(FEATURE_LIMIT),
        "action_low": np.float32(-1.0), "action_high": np.float32(1.0),
    }  # fmt: skip
    nodes = [
        helper.make_node("Mul", ["known", "per_scale"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "feature_low", "feature_high"], ["features"]),
    ]
    last = "features"
    layers = policy.network.layers
    for k, (weight, bias) in enumerate(layers):
        constants |= {f"weight_{k}": weight, f"bias_{k}": bias}
        nodes.append(
            helper.make_node("Gemm", [last, f"weight_{k}", f"bias_{k}"], [f"sum_{k}"], transB=1)
        )
        last = f"sum_{k}"
        if k + 1 < len(layers):
            operator = _OPERATORS[policy.network.activation]
            nodes.append(helper.make_node(operator, [last], [f"layer_{k}"]))
            last = f"layer_{k}"
    if policy.base_gain is not None:
        feedback, feedforward = _base(policy)
        constants |= {"feedback": feedback, "feedforward": feedforward}
        nodes += [
            helper.make_node("Gemm", ["known", "feedback", "feedforward"], ["base"], transB=1),
            helper.make_node("Add", [last, "base"], ["whole"]),
        ]
        last = "whole"
    nodes.append(helper.make_node("Clip", [last, "action_low", "action_high"], ["action"]))
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("known", TensorProto.FLOAT, ["n", len(policy.scales)])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["n", 4])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)])
    model.ir_version = _IR_VERSION
    names = [*design.states, *(f"integral_{name}" for name in integrated_readings(design))]
    names += BEYOND if TargetView(design.sensors).aims else []
    helper.set_model_props(
        model,
        {
            "known": " ".join(names),
            "sensors": design.sensors,
            "command": "action_trim + action_scale * action [rad/s, rad/s, rad, rad]",
            "action_trim": " ".join(map(str, design.action_trim)),
            "action_scale": " ".join(map(str, design.action_scale)),
        },
    )
    return bytes(model.SerializeToString())


def _base(policy: Policy) -> tuple[np.ndarray, np.ndarray]:
    """Minus the base's gain, 0 for what it does not feed back (4, k), and its feed-forward (4,)."""
    gain, design = policy.base_gain, policy.estimator
    assert gain is not None
    feedback = np.zeros((4, len(policy.scales)), dtype=np.float32)
    feedback[:, : gain.shape[1]] = -gain
    offset = design.action_trim - design.command_trim
    return feedback, (-offset / design.action_scale).astype(np.float32)
