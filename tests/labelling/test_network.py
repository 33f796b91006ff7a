"""Labels that a network gives to images, and networks that are refused."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.class_file import class_table
from octoreplay.errors import ConfigError, InputError
from octoreplay.labelling.network import Network, NetworkOptions
from support.networks import COLORS, label_network, nearest_color_network

CLASSES = class_table([{"name": name, "raw_labels": [raw]} for raw, name in enumerate(("red", "green", "blue"))])
rng = np.random.default_rng(3)
TRUE = rng.integers(0, 3, (24, 32))
IMAGE = np.clip(COLORS[TRUE] + rng.normal(0.0, 6.0, (24, 32, 3)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("layout", ["nchw", "nhwc"])
@pytest.mark.parametrize("softmax", [False, True])
def test_labels_are_those_of_the_largest_score(tmp_path: Path, layout: str, softmax: bool) -> None:
    path = nearest_color_network(tmp_path / "net.onnx", layout=layout, softmax=softmax)
    found = Network(path, CLASSES).label(IMAGE, "image")
    assert np.array_equal(found.raw, TRUE)
    assert found.confidences is not None
    # The softmax of -20 |x - c|^2, by its definition.
    logits = -20.0 * ((IMAGE[..., None, :] / 255.0 - COLORS / 255.0) ** 2).sum(axis=-1)
    shares = np.exp(logits - logits.max(axis=-1, keepdims=True))
    expected = 255.0 * (shares / shares.sum(axis=-1, keepdims=True)).max(axis=-1)
    assert np.abs(found.confidences - expected).max() <= 1.0


def test_an_output_of_labels_has_no_confidences(tmp_path: Path) -> None:
    found = Network(label_network(tmp_path / "net.onnx"), CLASSES).label(IMAGE, "image")
    assert np.array_equal(found.raw, TRUE)
    assert found.confidences is None


@pytest.mark.parametrize(
    ("metadata", "options"),
    [
        ({"Image.BitmapPixelFormat": "Bgr8"}, {}),
        ({}, {"channels": "bgr"}),
    ],
)
def test_channels_are_swapped_as_metadata_or_options_say(tmp_path: Path, metadata: dict, options: dict) -> None:
    path = nearest_color_network(tmp_path / "net.onnx", colors=COLORS[:, ::-1], metadata=metadata)
    assert np.array_equal(Network(path, CLASSES, NetworkOptions(**options)).label(IMAGE, "image").raw, TRUE)


@pytest.mark.parametrize(
    ("metadata", "options", "scale"),
    [
        ({"Image.NominalPixelRange": "NominalRange_0_255"}, {}, 255.0),
        ({"scale": "1.0"}, {}, 255.0),
        ({"scale": "1.0"}, {"scale": 1 / 255}, 1.0),
        ({"mean": "[0.1, 0.1, 0.1]", "std": "0.5"}, {"mean": (0.0,), "std": (1.0,)}, 1.0),
    ],
)
def test_pixels_are_normalised_as_metadata_or_options_say(
    tmp_path: Path, metadata: dict, options: dict, scale: float
) -> None:
    path = nearest_color_network(tmp_path / "net.onnx", colors=COLORS * scale, metadata=metadata)
    assert np.array_equal(Network(path, CLASSES, NetworkOptions(**options)).label(IMAGE, "image").raw, TRUE)


def test_an_image_is_resized_to_a_fixed_input_and_its_labels_back(tmp_path: Path) -> None:
    halves = np.repeat((np.arange(64) >= 32)[None].astype(int), 48, axis=0)
    path = nearest_color_network(tmp_path / "net.onnx", size=(32, 24), stride=2)
    found = Network(path, CLASSES).label(COLORS[halves].astype(np.uint8), "image").raw
    assert found.shape == halves.shape
    assert np.array_equal(found[:, np.r_[:29, 35:64]], halves[:, np.r_[:29, 35:64]])


def test_the_offset_shifts_labels(tmp_path: Path) -> None:
    shifted = class_table([{"name": name} for name in ("red", "green", "blue")])
    path = nearest_color_network(tmp_path / "net.onnx")
    assert np.array_equal(Network(path, shifted, NetworkOptions(label_offset=1)).label(IMAGE, "").raw, TRUE + 1)
    with pytest.raises(ConfigError, match=r"labels 0 to 2; the class table does not have 0: .*--label-offset 1"):
        Network(path, shifted)


def test_a_label_of_an_output_that_the_table_does_not_have_is_refused(tmp_path: Path) -> None:
    network = Network(label_network(tmp_path / "net.onnx"), class_table([{"name": "red", "raw_labels": [0]}]))
    with pytest.raises(ConfigError, match="does not have 1, 2"):
        network.label(IMAGE, "image")


@pytest.mark.parametrize("content", [b"", b"no model", b"\x08\x07" + b"\xff" * 200])
def test_a_file_that_is_no_model_is_refused_in_one_sentence(tmp_path: Path, content: bytes, capfd) -> None:
    path = tmp_path / "net.onnx"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"net\.onnx: .*no ONNX model") as caught:
        Network(path, CLASSES)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_a_damaged_model_is_refused_or_read_as_another(tmp_path: Path) -> None:
    path = nearest_color_network(tmp_path / "net.onnx")
    whole, random = path.read_bytes(), np.random.default_rng(1)
    num_refused = 0
    for _ in range(60):
        damaged = bytearray(whole[: random.integers(1, len(whole) + 1)])
        for place in random.integers(0, len(damaged), 3):
            damaged[place] = random.integers(256)
        path.write_bytes(damaged)
        try:
            Network(path, CLASSES).label(IMAGE, "image")
        except (InputError, ConfigError):
            num_refused += 1
    assert num_refused > 30


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        Network(tmp_path / "none.onnx", CLASSES)


def test_a_network_that_cannot_take_the_image_names_the_remedy(tmp_path: Path) -> None:
    path = nearest_color_network(tmp_path / "net.onnx", size=(32, 24))
    with pytest.raises(ConfigError, match="fixed size of 32x24"):
        Network(path, CLASSES, NetworkOptions(input_size=(64, 48)))


def test_values_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    path = nearest_color_network(tmp_path / "net.onnx", colors=np.full((3, 3), np.nan))
    with pytest.raises(InputError, match="is not finite"):
        Network(path, CLASSES).label(IMAGE, "image")


def test_a_network_of_one_class_is_refused(tmp_path: Path) -> None:
    path = nearest_color_network(tmp_path / "net.onnx", colors=COLORS[:1])
    with pytest.raises(InputError, match="has 1 channels"):
        Network(path, CLASSES)


def test_an_unknown_output_is_refused_with_the_names(tmp_path: Path) -> None:
    path = nearest_color_network(tmp_path / "net.onnx")
    with pytest.raises(ConfigError, match="no output 'other'; its outputs are logits"):
        Network(path, CLASSES, NetworkOptions(output_name="other"))


def test_the_missing_package_is_named_with_its_remedy(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match=r"pip install 'octoreplay\[label\]'"):
        Network(tmp_path / "net.onnx", CLASSES)


@pytest.mark.parametrize(
    "options",
    [{"std": (0.0,)}, {"scale": 0.0}, {"label_offset": -1}, {"input_size": (0, 5)}, {"mean": (float("nan"),)}],
)
def test_options_out_of_range_are_refused(options: dict) -> None:
    with pytest.raises(ConfigError):
        NetworkOptions(**options)
