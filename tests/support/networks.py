"""ONNX networks for tests, built with the package onnx."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

COLORS = np.array([(200, 30, 30), (30, 180, 40), (40, 60, 220)], dtype=np.float64)
"""Colours of the classes 0, 1 and 2 of ``nearest_color_network``."""


def nearest_color_network(
    path: Path, *, colors: np.ndarray = COLORS, size: tuple[int, int] | None = None, softmax: bool = False,
    layout: str = "nchw", metadata: dict[str, str] | None = None, stride: int = 1,
) -> Path:  # fmt: skip
    """Write a network that gives each pixel the class of the nearest colour: the logits -|x - c|^2 + |x|^2, scaled."""
    centres = colors / 255.0
    weights = 40.0 * centres[..., None, None]
    bias = -20.0 * (centres**2).sum(axis=1)
    width, height = size or ("width", "height")
    is_nhwc = layout == "nhwc"
    nodes, name = [], "image"
    if is_nhwc:
        nodes.append(helper.make_node("Transpose", [name], ["channels_first"], perm=[0, 3, 1, 2]))
        name = "channels_first"
    nodes.append(helper.make_node("Conv", [name, "weights", "bias"], ["logits"], strides=[stride, stride]))
    name = "logits"
    if softmax:
        nodes.append(helper.make_node("Softmax", [name], ["scores"], axis=1))
        name = "scores"
    if is_nhwc:
        nodes.append(helper.make_node("Transpose", [name], ["last"], perm=[0, 2, 3, 1]))
        name = "last"
    shape = [1, height, width, 3] if is_nhwc else [1, 3, height, width]
    found: list[Any] = [1, "h", "w", len(colors)] if is_nhwc else [1, len(colors), "h", "w"]
    return _saved(path, nodes, shape, name, found, {"weights": weights, "bias": bias}, metadata)


def label_network(path: Path, *, colors: np.ndarray = COLORS) -> Path:
    """Write a network that gives each pixel the index of its class, int64 (1, H, W)."""
    centres = colors / 255.0
    nodes = [
        helper.make_node("Conv", ["image", "weights", "bias"], ["logits"]),
        helper.make_node("ArgMax", ["logits"], ["labels"], axis=1, keepdims=0),
    ]
    constants = {"weights": 2.0 * centres[..., None, None], "bias": -(centres**2).sum(axis=1)}
    return _saved(path, nodes, [1, 3, "h", "w"], "labels", [1, "h", "w"], constants, None, TensorProto.INT64)


def _saved(
    path: Path, nodes: list[Any], shape: list[Any], output: str, found: list[Any], constants: dict[str, np.ndarray],
    metadata: dict[str, str] | None, kind: int = TensorProto.FLOAT,
) -> Path:  # fmt: skip
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info(output, kind, found)],
        [numpy_helper.from_array(np.asarray(value, dtype=np.float32), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, metadata or {})
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path
