"""Fits a small network to the images of simulated teams: ``village_network.py TEAM... -o NETWORK.onnx``.

The teams are folders of ``octoreplay simulate --colour raw --label-noise 0``. The network has four convolutions: the
means of each colour over 3x3 and 9x9 pixels, a hidden layer of random weights with ReLU, and an output layer that is
fitted by least squares. Output k is the class k + 1 of the simulated village. The script prints the share of pixels
with the right class, for the training images and for the teams of ``--test``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from mcap.reader import make_reader
from onnx import TensorProto, helper, numpy_helper

from octoreplay.io.messages.ros_types import typestore
from octoreplay.simulate.world import village_classes

NUM_HIDDEN = 192
NUM_PIXELS = 300_000
RIDGE = 1e-4
GAIN = 12.0
NO_LABEL = 255


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("teams", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--test", nargs="*", type=Path, default=[], help="teams for the accuracy alone")
    arguments = parser.parse_args()
    images, labels = team_images(arguments.teams)
    onnx.save(fitted(images, labels), arguments.output)
    print(f"training: {accuracy(arguments.output, images, labels):.2%} of the measured pixels")
    for folder in arguments.test:
        print(f"{folder}: {accuracy(arguments.output, *team_images([folder])):.2%} of the measured pixels")


def team_images(folders: list[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Return the colour images (N, H, W, 3) and label images (N, H, W) of teams."""
    images, labels = [], []
    for path in sorted(log for folder in folders for log in folder.glob("husky_*.mcap")):
        with path.open("rb") as file:
            for schema, channel, stored in make_reader(file).iter_messages():
                if channel.topic.endswith(("/color/image_raw", "/labels/image_raw")):
                    image: Any = typestore().deserialize_cdr(stored.data, schema.name)
                    pixels = np.asarray(image.data).reshape(image.height, image.width, -1)
                    (images if pixels.shape[2] == 3 else labels).append(pixels)
    return np.array(images), np.array(labels)[..., 0]


def fitted(images: np.ndarray, labels: np.ndarray) -> onnx.ModelProto:
    """Return the network that is fitted to images (N, H, W, 3) and their classes (N, H, W)."""
    rng = np.random.default_rng(0)
    num_classes = village_classes().num_classes
    chosen = np.flatnonzero(labels.reshape(-1) != NO_LABEL)
    classes = labels.reshape(-1)[chosen].astype(int)
    # Rare classes have as many pixels as frequent ones up to the square root of their share.
    share = np.sqrt(np.bincount(classes, minlength=num_classes + 1)) + 1e-9
    weights = 1.0 / share[classes]
    chosen = rng.choice(chosen, min(NUM_PIXELS, chosen.size), replace=False, p=weights / weights.sum())
    inputs = np.stack([blurred(images, size).reshape(-1, 3)[chosen] for size in (3, 9)], axis=1).reshape(-1, 6)
    hidden = (rng.standard_normal((6, NUM_HIDDEN)) * 2.0).astype(np.float32)
    # A unit's bend lies at a random pixel of the training images.
    bias = -(inputs[rng.integers(len(inputs), size=NUM_HIDDEN)] * hidden.T).sum(axis=1)
    features = np.maximum(inputs @ hidden + bias, 0.0).astype(np.float64)
    features = np.hstack([features, np.ones((len(features), 1))])
    targets = np.eye(num_classes)[labels.reshape(-1)[chosen].astype(int) - 1]
    gram = features.T @ features + RIDGE * len(features) * np.eye(features.shape[1])
    output = GAIN * np.linalg.solve(gram, features.T @ targets)
    return model(hidden, bias, output.astype(np.float32))


def blurred(images: np.ndarray, size: int) -> np.ndarray:
    """Return the means (N, H, W, 3) over squares of pixels, with zeros outside the images, of values 0 to 1."""
    half = size // 2
    padded = np.pad(images.astype(np.float32) / 255.0, ((0, 0), (half + 1, half), (half + 1, half), (0, 0)))
    sums = padded.cumsum(axis=1, dtype=np.float64).cumsum(axis=2)
    area = sums[:, size:, size:] - sums[:, :-size, size:] - sums[:, size:, :-size] + sums[:, :-size, :-size]
    return (area / size**2).astype(np.float32)


def model(hidden: np.ndarray, bias: np.ndarray, output: np.ndarray) -> onnx.ModelProto:
    """Return the ONNX model of fitted weights: hidden (6, M) with bias (M,), and output (M + 1, C)."""
    constants = {
        "mean_3": channelwise(3), "mean_9": channelwise(9),
        "hidden": hidden.T[..., None, None], "hidden_bias": bias.astype(np.float32),
        "output": output[:-1].T[..., None, None], "output_bias": output[-1],
    }  # fmt: skip
    nodes = [
        helper.make_node("Conv", ["image", "mean_3"], ["fine"], group=3, pads=[1, 1, 1, 1]),
        helper.make_node("Conv", ["image", "mean_9"], ["coarse"], group=3, pads=[4, 4, 4, 4]),
        helper.make_node("Concat", ["fine", "coarse"], ["means"], axis=1),
        helper.make_node("Conv", ["means", "hidden", "hidden_bias"], ["sums"]),
        helper.make_node("Relu", ["sums"], ["features"]),
        helper.make_node("Conv", ["features", "output", "output_bias"], ["logits"]),
    ]
    graph = helper.make_graph(
        nodes,
        "village",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "height", "width"])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, output.shape[1], "height", "width"])],
        [
            numpy_helper.from_array(np.ascontiguousarray(value, dtype=np.float32), name)
            for name, value in constants.items()
        ],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(made, {"Image.BitmapPixelFormat": "Rgb8", "Image.NominalPixelRange": "Normalized_0_1"})
    onnx.checker.check_model(made)
    return made


def channelwise(size: int) -> np.ndarray:
    """Return the weights (3, 1, size, size) of a convolution that is the mean of each channel."""
    return np.full((3, 1, size, size), 1.0 / size**2)


def accuracy(path: Path, images: np.ndarray, labels: np.ndarray) -> float:
    """Return the share of the measured pixels to which a network gives the right class."""
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    right = total = 0
    for image, label in zip(images, labels, strict=True):
        fed = (image.astype(np.float32) / 255.0).transpose(2, 0, 1)[None]
        found = session.run(None, {"image": fed})[0][0].argmax(axis=0) + 1
        is_measured = label != NO_LABEL
        right += int((found == label)[is_measured].sum())
        total += int(is_measured.sum())
    return right / total


if __name__ == "__main__":
    main()
