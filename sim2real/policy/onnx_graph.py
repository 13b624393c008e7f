"""A policy as an ONNX graph: normaliser, network and action bounds in one file for any ONNX runtime."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from sim2real.policy.contract import PolicyContract
from sim2real.policy.runner import OBSERVATION_CLIP, layers_of

OPSET = 17
IR_VERSION = 8  # that of the ONNX release with opset 17, not the newest, so that older runtimes on a robot load it


def build_onnx(weights: Mapping[str, np.ndarray], contract: PolicyContract) -> bytes:
    """Return the serialised model: ``observation (1, O)`` -> ``action (1, A)``, float32.

    The batch axis is there because ONNX's Gemm takes matrices only. The contract is stored in the model's metadata.
    """
    from onnx import TensorProto, checker, helper, numpy_helper

    low, high = weights["low"], weights["high"]
    constants = {
        "mean": weights["mean"],
        "std": weights["std"],
        "clip_low": np.float32(-OBSERVATION_CLIP),
        "clip_high": np.float32(OBSERVATION_CLIP),
        "minus_one": np.float32(-1.0),
        "one": np.float32(1.0),
        "low": low,
        "half_range": 0.5 * (high - low),
    }
    nodes = [
        helper.make_node("Sub", ["observation", "mean"], ["centred"]),
        helper.make_node("Div", ["centred", "std"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "clip_low", "clip_high"], ["x0"]),
    ]
    layers = layers_of(weights)
    for i, (kernel, bias) in enumerate(layers):
        constants |= {f"kernel{i}": kernel, f"bias{i}": bias}
        last = i == len(layers) - 1
        nodes.append(helper.make_node("Gemm", [f"x{i}", f"kernel{i}", f"bias{i}"], ["u" if last else f"y{i}"]))
        if not last:
            nodes.append(helper.make_node("Tanh", [f"y{i}"], [f"x{i + 1}"]))
    nodes += [
        helper.make_node("Clip", ["u", "minus_one", "one"], ["bounded"]),
        helper.make_node("Add", ["bounded", "one"], ["shifted"]),
        helper.make_node("Mul", ["shifted", "half_range"], ["stretched"]),
        helper.make_node("Add", ["stretched", "low"], ["action"]),
    ]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, [1, contract.observation_size])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, [1, len(contract.action)])],
        [numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    properties = {
        "observation_names": ",".join(contract.observation_names),
        "action_names": ",".join(term.name for term in contract.action),
        "rate_hz": repr(contract.rate_hz),
        "contract": json.dumps(contract.to_dict()),
    }
    helper.set_model_props(model, properties)
    checker.check_model(model, full_check=True)
    return model.SerializeToString()
