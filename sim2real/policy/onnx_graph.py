"""A policy as an ONNX graph: normaliser, network and action bounds in one file for any ONNX runtime."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from sim2real.policy.contract import NetworkSpec, PolicyContract
from sim2real.policy.runner import INITIAL_CARRY, OBSERVATION_CLIP, gru_of, layers_of
from sim2real.types import Json

if TYPE_CHECKING:
    from onnx import NodeProto, ValueInfoProto

OPSET = 17
IR_VERSION = 8  # the version of the ONNX release with opset 17, so that older runtimes on a robot load the file


def build_onnx(weights: Mapping[str, np.ndarray], contract: PolicyContract, spec: NetworkSpec | None = None) -> bytes:
    """Return the serialised model: ``observation (1, O)`` -> ``action (1, A)``, float32.

    The batch axis is needed because ONNX's Gemm takes only matrices. A recurrent network also has an input ``carry_0``
    and an output ``next_carry_0``.

    Args:
        spec: One of the networks in ``BUILT_IN``; default: a perceptron whose output is clipped.
    """
    from onnx import TensorProto, checker, helper, numpy_helper

    spec = spec or NetworkSpec()
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
    # Normalise and clip the observation.
    nodes = [
        helper.make_node("Sub", ["observation", "mean"], ["centred"]),
        helper.make_node("Div", ["centred", "std"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "clip_low", "clip_high"], ["x0" if spec.name == "mlp" else "x"]),
    ]

    # The network: perhaps a gated recurrent unit as the first layer, then tanh layers and a linear layer.
    initial = []
    if spec.name == "gru":
        gru = gru_of(weights)
        initial = [np.zeros(len(gru["recurrent"]), np.float32)]
        constants |= {f"gru_{name}": array for name, array in gru.items()}
        nodes += _gru_nodes()
    layers = layers_of(weights)
    for i, (kernel, bias) in enumerate(layers):
        constants |= {f"kernel{i}": kernel, f"bias{i}": bias}
        last = i == len(layers) - 1
        nodes.append(helper.make_node("Gemm", [f"x{i}", f"kernel{i}", f"bias{i}"], ["u" if last else f"y{i}"]))
        if not last:
            nodes.append(helper.make_node("Tanh", [f"y{i}"], [f"x{i + 1}"]))

    # Bound the output, and scale it to the action's range.
    bound = ["u"] if spec.squash else ["u", "minus_one", "one"]
    nodes += [
        helper.make_node("Tanh" if spec.squash else "Clip", bound, ["bounded"]),
        helper.make_node("Add", ["bounded", "one"], ["shifted"]),
        helper.make_node("Mul", ["shifted", "half_range"], ["stretched"]),
        helper.make_node("Add", ["stretched", "low"], ["action"]),
    ]

    # The carry is an input and an output of the graph; its initial value is in the model's metadata.
    def described(name: str, size: int) -> ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, size])

    graph = helper.make_graph(
        nodes,
        "policy",
        [described("observation", contract.observation_size), *(described("carry_0", len(c)) for c in initial)],
        [described("action", len(contract.action)), *(described("next_carry_0", len(c)) for c in initial)],
        [numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    if initial:
        helper.set_model_props(model, {INITIAL_CARRY: json.dumps([array.tolist() for array in initial])})
    checker.check_model(model, full_check=True)
    return with_contract(model.SerializeToString(), contract)


def with_contract(graph: bytes, contract: PolicyContract) -> bytes:
    """Return a serialised model with the contract in its metadata."""
    import onnx

    model = onnx.load_from_string(graph)
    properties = {entry.key: entry.value for entry in model.metadata_props} | {
        "observation_names": comma_list(contract.observation_names),
        "action_names": comma_list(term.name for term in contract.action),
        "rate_hz": repr(contract.rate_hz),
        "contract": json.dumps(contract.to_dict()),
    }
    onnx.helper.set_model_props(model, properties)
    return model.SerializeToString()


def comma_list(names: Iterable[str]) -> str:
    """Join names by commas, as other programs read them; a comma in a name becomes a semicolon."""
    return ",".join(name.replace(",", ";") for name in names)


def _gru_nodes() -> list[NodeProto]:
    """Return a gated recurrent unit from ``x`` and ``carry_0`` to ``next_carry_0`` and ``x0``.

    ONNX's GRU has other axes and a second bias.
    """
    from onnx import helper

    def node(kind: str, inputs: str, outputs: str, **options: Json) -> NodeProto:
        return helper.make_node(kind, inputs.split(), outputs.split(), **options)

    return [
        node("Gemm", "x gru_kernel gru_bias", "seen"),
        node("MatMul", "carry_0 gru_recurrent", "kept"),
        node("Split", "seen", "seen_r seen_z seen_n", axis=1),
        node("Split", "kept", "kept_r kept_z kept_n", axis=1),
        node("Add", "seen_r kept_r", "sum_r"),
        node("Add", "seen_z kept_z", "sum_z"),
        node("Sigmoid", "sum_r", "r"),
        node("Sigmoid", "sum_z", "z"),
        node("Mul", "r kept_n", "reset_n"),
        node("Add", "seen_n reset_n", "sum_n"),
        node("Tanh", "sum_n", "n"),
        node("Sub", "one z", "new"),
        node("Mul", "new n", "added"),
        node("Mul", "z carry_0", "held"),
        node("Add", "added held", "next_carry_0"),
        node("Identity", "next_carry_0", "x0"),
    ]
