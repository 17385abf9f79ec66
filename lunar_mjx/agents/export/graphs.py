"""A policy as a graph for other runtimes: ONNX for ONNX Runtime and its like, StableHLO for XLA.

Both take observations as the environment gives them and return actions in [-1, 1]: normalising is part of the graph.
"""

from __future__ import annotations

import dataclasses
import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.export import export, symbolic_shape

from lunar_mjx.agents.networks import MOST_DEVIATIONS
from lunar_mjx.agents.policy import Policy
from lunar_mjx.errors import UserError, bad_input


@dataclasses.dataclass(frozen=True)
class OnnxVersion:
    """The version of ONNX that is written."""

    # Of the ONNX file: the first that has layer normalisation, and the file format of that time (ONNX 1.12, 2022), so
    # that the runtimes of older robots read it.
    opset: int = 17
    ir_version: int = 8
    layer_norm_epsilon: float = 1e-6
    """What Flax's `LayerNorm` adds to a variance; the actor's layers are normalised by it."""


ONNX = OnnxVersion()


def to_onnx(policy: Policy) -> bytes:
    """The policy as an ONNX model: `obs` (batch, obs) to `action` (batch, action), float32.

    Raises:
      UserError: the package onnx is not installed, or the policy sees pictures.
    """
    if policy.network.get("picture"):
        remedy = "give --only stablehlo"
        raise bad_input("export", "network.picture", policy.network["picture"], "has no graph in ONNX yet", remedy)
    try:
        onnx: Any = importlib.import_module("onnx")
        helper, numpy_helper = onnx.helper, onnx.numpy_helper
    except ImportError:
        raise UserError(
            "export: the package onnx is not installed; give pip install 'lunar-mjx[export]', or --only stablehlo."
        ) from None
    nodes, weights = [], []

    def weight(name: str, value: Any) -> str:
        weights.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def add(operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    hidden = "obs"
    if policy.mean is not None and policy.deviation is not None:
        hidden = add("Sub", [hidden, weight("mean", policy.mean)], "centred")
        hidden = add("Div", [hidden, weight("deviation", policy.deviation)], "scaled")
        # Clipped as in training: an observation far outside must not reach the network as something it has never seen.
        bounds = [weight("least", -MOST_DEVIATIONS), weight("most", MOST_DEVIATIONS)]
        hidden = add("Clip", [hidden, *bounds], "normalised")
    layers, inner = policy.network["layers"], policy.params["params"]
    for i in range(len(layers) + 1):
        dense = inner[f"hidden_{i}"]
        parts = [weight(f"kernel_{i}", dense["kernel"]), weight(f"bias_{i}", dense["bias"])]
        hidden = add("Gemm", [hidden, *parts], f"dense_{i}")
        if i == len(layers):
            break
        hidden = _activation(add, policy.network["activation"], hidden, i)
        if policy.network["layer_norm"]:
            norm = inner[f"LayerNorm_{i}"]
            parts = [weight(f"norm_scale_{i}", norm["scale"]), weight(f"norm_bias_{i}", norm["bias"])]
            hidden = add("LayerNormalization", [hidden, *parts], f"norm_{i}", axis=-1, epsilon=ONNX.layer_norm_epsilon)
    add("Tanh", [hidden], "action")
    real = onnx.TensorProto.FLOAT
    ends = [
        helper.make_tensor_value_info(name, real, ["batch", policy.network[size]])
        for name, size in (("obs", "obs"), ("action", "actions"))
    ]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", ONNX.opset)], ir_version=ONNX.ir_version)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _activation(add: Any, name: str, hidden: str, i: int) -> str:
    if name == "swish":
        return add("Mul", [hidden, add("Sigmoid", [hidden], f"gate_{i}")], f"active_{i}")
    return add({"relu": "Relu", "elu": "Elu", "tanh": "Tanh"}[name], [hidden], f"active_{i}")


def to_stablehlo(policy: Policy) -> bytes:
    """The policy as `jax.export.deserialize` reads it, for CPUs and CUDA; its `mlir_module()` is the StableHLO text.

    Raises:
      UserError: the package flatbuffers is not installed.
    """
    (batch,) = symbolic_shape("batch")
    shape = jax.ShapeDtypeStruct((batch, policy.network["obs"]), jnp.float32)
    # On GPUs that round products to TF32 the exported policy would not be the one that was scored.
    with jax.default_matmul_precision("highest"):
        exported = export(jax.jit(policy.act), platforms=("cpu", "cuda"))(shape)
    try:
        return bytes(exported.serialize())
    except ImportError:
        raise UserError(
            "export: the package flatbuffers, in which JAX writes programs, is not installed; "
            "give pip install 'lunar-mjx[export]'."
        ) from None
