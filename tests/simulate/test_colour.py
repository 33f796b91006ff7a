"""Tests of the colour images of simulated robots, read from their logs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.simulate.world import village_classes
from support.long_suite import long
from support.stored_messages import pixels, read_messages

SMALL = SimulationConfig(
    num_robots=1, duration=2.0, rate=2.0, image=(80, 60), seed=5, world_size=24.0, label_noise=0.0, colour="raw"
)
CAMERA = "/husky_1/camera"


def simulated(folder: Path, **changes) -> dict:
    """Messages of a simulated robot's log by topic."""
    simulate_team(folder, dataclasses.replace(SMALL, **changes))
    return read_messages(folder / "husky_1.mcap")


@pytest.fixture(scope="module")
def raw(tmp_path_factory) -> dict:
    return simulated(tmp_path_factory.mktemp("raw") / "team")


def colours(messages: dict) -> np.ndarray:
    """Colour images (N, H, W, 3) of a log with raw images."""
    found = [image for _, image in messages[f"{CAMERA}/color/image_raw"]]
    assert {image.encoding for image in found} == {"rgb8"}
    return np.array([np.asarray(image.data).reshape(image.height, image.width, 3) for image in found])


def test_pixels_have_the_hue_of_their_class(raw) -> None:
    images = colours(raw).astype(float)
    labels = np.array([pixels(image) for _, image in raw[f"{CAMERA}/labels/image_raw"]])
    table = village_classes()
    for class_id in (1, 2):
        found = images[labels == class_id].mean(axis=0)
        expected = table.colors[class_id - 1].astype(float)
        assert found @ expected > 0.98 * np.linalg.norm(found) * np.linalg.norm(expected)
    # Light, texture and noise: pixels of one class differ.
    assert images[labels == 1].std(axis=0).min() > 5.0


def test_images_have_the_stamps_and_the_intrinsics_of_the_depth_images(raw) -> None:
    depth, colour = raw[f"{CAMERA}/depth/image_raw"], raw[f"{CAMERA}/color/image_raw"]
    assert [stamp for stamp, _ in depth] == [stamp for stamp, _ in colour]
    assert {image.header.frame_id for _, image in (*depth, *colour)} == {"husky_1/camera_optical_frame"}
    of_depth, of_colour = (raw[f"{CAMERA}/{name}/camera_info"][0][1] for name in ("depth", "color"))
    assert np.array_equal(of_depth.k, of_colour.k)


@long
def test_colour_changes_nothing_else_in_a_log(raw, tmp_path: Path) -> None:
    plain = simulated(tmp_path / "team", colour=None)
    assert set(raw) - set(plain) == {f"{CAMERA}/color/image_raw", f"{CAMERA}/color/camera_info"}
    for name in ("depth", "labels"):
        topic = f"{CAMERA}/{name}/image_raw"
        assert all(
            np.array_equal(pixels(a), pixels(b)) for (_, a), (_, b) in zip(raw[topic], plain[topic], strict=True)
        )


@long
def test_equal_settings_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        simulated(tmp_path / name, colour="jpeg")
    assert (tmp_path / "a/husky_1.mcap").read_bytes() == (tmp_path / "b/husky_1.mcap").read_bytes()


@long
@pytest.mark.parametrize(("form", "error"), [("png", 0.0), ("jpeg", 12.0)])
def test_compressed_images_hold_the_same_pixels(raw, tmp_path: Path, form: str, error: float) -> None:
    messages = simulated(tmp_path / "team", colour=form)
    found = [
        cv2.imdecode(np.asarray(m.data), cv2.IMREAD_COLOR)[..., ::-1]
        for _, m in messages[f"{CAMERA}/color/image_raw/compressed"]
    ]
    assert np.abs(np.array(found).astype(float) - colours(raw)).mean() <= error


@long
def test_a_second_camera_sees_the_scene_from_its_place(raw, tmp_path: Path) -> None:
    messages = simulated(tmp_path / "team", colour_offset=(0.5, 0.1, 0.0))
    frames = {t.child_frame_id: t for _, m in messages["/tf_static"] for t in m.transforms}
    of_depth, of_colour = (frames[f"husky_1/{name}_optical_frame"].transform for name in ("camera", "color"))
    assert of_depth.rotation == of_colour.rotation
    # x of an optical frame points right, which is -y of the base.
    assert of_colour.translation.y - of_depth.translation.y == pytest.approx(-0.5)
    assert {m.header.frame_id for _, m in messages[f"{CAMERA}/color/image_raw"]} == {"husky_1/color_optical_frame"}
    assert np.abs(colours(messages).astype(float) - colours(raw)).mean() > 5.0


@long
def test_a_team_without_labels_has_neither_labels_nor_classes(tmp_path: Path) -> None:
    messages = simulated(tmp_path / "team", has_labels=False)
    assert not [topic for topic in messages if "label" in topic]
    config = load_team_file(tmp_path / "team" / "team.yaml")
    assert config.classes is None
    assert config.robots[0].label_topic is None


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"colour": "gif"}, "not one of raw, jpeg, png"),
        ({"colour_offset": (9.0, 0.0, 0.0)}, "colour_offset: 9 is not between"),
        ({"colour": None, "colour_offset": (0.1, 0.0, 0.0)}, "needs colour images"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        dataclasses.replace(SMALL, **changes)
