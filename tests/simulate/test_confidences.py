"""Tests of the confidences of simulated labels."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError
from octoreplay.io.robots.discover import resolve
from octoreplay.simulate.camera import add_label_noise
from octoreplay.simulate.confidences import LabelErrors, largest_label_noise, softmax_confidences
from octoreplay.simulate.scene import NO_LABEL
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from support.command_line import assert_fails, octoreplay
from support.stored_messages import pixels, read_messages

SMALL = SimulationConfig(
    num_robots=1, duration=4.0, rate=4.0, image=(80, 60), seed=5, world_size=24.0, label_noise=0.3, depth_noise=0.0
)
LABELS = "/husky_1/camera/labels/image_raw"
CONFIDENCES = "/husky_1/camera/label_confidence/image_raw"


def images(folder: Path, topic: str) -> np.ndarray:
    """Images (T, H, W) of a topic."""
    return np.stack([pixels(image) for _, image in read_messages(folder / "husky_1.mcap")[topic]])


@pytest.fixture(scope="module")
def exact(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("exact") / "team"
    simulate_team(folder, dataclasses.replace(SMALL, label_noise=0.0))
    return folder


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("calibrated") / "team"
    simulate_team(folder, dataclasses.replace(SMALL, confidences=1.0))
    return folder


def drawn(share: float, num_candidates: int, seed: int) -> np.ndarray:
    """Probabilities (300, 300) of errors at points in many places."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-60.0, 60.0, (300, 300, 3))
    return LabelErrors(share, num_candidates, rng).probabilities(points, rng)


def assert_calibrated(confidences: np.ndarray, is_right: np.ndarray) -> None:
    """Check that the share of right labels in each of ten bins of confidences is their mean, within sampling error."""
    bins = confidences.astype(int) * 10 // 256
    for index in np.unique(bins):
        right, mean = is_right[bins == index], confidences[bins == index].mean() / 255
        # Five standard deviations, and three labels for bins of a few.
        assert abs(right.sum() - mean * right.size) <= 5 * np.sqrt(mean * (1 - mean) * right.size) + 3


@settings(max_examples=30)
@given(st.floats(0.0, 1.0), st.sampled_from([2, 3, 8, 248]), st.integers(0, 1000))
def test_errors_have_the_given_mean_and_are_at_most_those_of_random_labels(level, num_candidates, seed):
    most = largest_label_noise(num_candidates)
    errors = drawn(level * most, num_candidates, seed)
    assert errors.min() >= 0
    assert errors.max() <= most
    # 65,536 places and twice as many pixels; a place has a standard deviation below 0.5.
    assert errors.mean() == pytest.approx(level * most, abs=0.02)


@pytest.mark.parametrize("num_candidates", [2, 8])
def test_labels_are_right_as_often_as_their_confidence_says(num_candidates):
    errors = drawn(0.3, num_candidates, 0)
    labels = np.random.default_rng(1).integers(1, num_candidates + 1, errors.shape).astype(np.uint8)
    noisy = add_label_noise(labels, errors, num_candidates, np.random.default_rng(2))
    confidences = softmax_confidences(errors, num_candidates, 1.0)
    assert confidences.min() >= 255 // num_candidates
    assert_calibrated(confidences, labels == noisy)
    # Both in single pixels and in places, the confidences differ.
    assert confidences.std() > 40


def test_places_differ_and_keep_their_probability_in_every_image():
    rng = np.random.default_rng(0)
    model = LabelErrors(0.3, 8, rng)
    corners = 2.0 * np.indices((20, 20, 1)).reshape(3, -1).T
    points = corners[:, None] + rng.uniform(0.0, 2.0, (400, 400, 3))
    first, second = (model.probabilities(points, rng).mean(axis=1) for _ in range(2))
    assert first.std() > 0.1
    np.testing.assert_allclose(first, second, atol=0.1)


@given(st.floats(0.0, 0.875), st.floats(0.1, 5.0))
def test_confidences_are_those_of_the_softmax_of_divided_logits(error, temperature):
    with np.errstate(divide="ignore"):
        logits = np.log([1.0 - error, *[error / 7] * 7]) / temperature
    softmax = np.exp(logits - logits.max())
    expected = 255 * softmax[0] / softmax.sum()
    assert abs(float(softmax_confidences(np.array([error]), 8, temperature)[0]) - expected) <= 0.5 + 1e-6


def test_a_log_has_calibrated_confidences_and_the_given_share_of_wrong_labels(exact, calibrated):
    true, labels, confidences = images(exact, LABELS), images(calibrated, LABELS), images(calibrated, CONFIDENCES)
    measured = true != NO_LABEL
    np.testing.assert_array_equal(labels == NO_LABEL, true == NO_LABEL)
    assert not confidences[~measured].any()
    is_right = (labels == true)[measured]
    # Few places are in view, and each has a share of its own.
    assert is_right.mean() == pytest.approx(0.7, abs=0.1)
    assert_calibrated(confidences[measured], is_right)


def test_confidences_of_a_low_temperature_are_too_high(exact, calibrated, tmp_path):
    simulate_team(tmp_path / "team", dataclasses.replace(SMALL, confidences=0.5))
    np.testing.assert_array_equal(images(tmp_path / "team", LABELS), images(calibrated, LABELS))
    true, confidences = images(exact, LABELS), images(tmp_path / "team", CONFIDENCES)
    measured = true != NO_LABEL
    right = (images(calibrated, LABELS) == true)[measured].mean()
    assert confidences[measured].mean() / 255 > right + 0.05
    with pytest.raises(AssertionError):
        assert_calibrated(confidences[measured], (images(calibrated, LABELS) == true)[measured])


def test_the_team_file_names_the_confidences_and_a_log_alone_gives_them(calibrated):
    config = load_team_file(calibrated / "team.yaml")
    assert config.robots[0].confidence_topic == CONFIDENCES
    alone = dataclasses.replace(
        config, robots=(dataclasses.replace(config.robots[0], confidence_topic=None, label_topic=None),)
    )
    assert resolve(alone).robots[0].confidence_topic == CONFIDENCES


def test_points_of_a_lidar_have_confidences(tmp_path):
    config = dataclasses.replace(SMALL, sensor="lidar", scan=(16, 90), label_noise=0.2, confidences=1.0)
    for folder, noise in (("noisy", 0.2), ("exact", 0.0)):
        simulate_team(tmp_path / folder, dataclasses.replace(config, label_noise=noise))
    tables = []
    for folder in ("noisy", "exact"):
        clouds = [cloud for _, cloud in read_messages(tmp_path / folder / "husky_1.mcap")["/husky_1/lidar/points"]]
        assert [field.name for field in clouds[0].fields] == ["x", "y", "z", "label", "label_confidence"]
        dtype = [("xyz", "<f4", 3), ("label", "<u2"), ("confidence", "u1")]
        tables.append(np.concatenate([np.frombuffer(cloud.data, dtype) for cloud in clouds]))
    assert_calibrated(tables[0]["confidence"], tables[0]["label"] == tables[1]["label"])
    assert (tables[1]["confidence"] == 255).all()


def test_options_that_do_not_fit_are_refused(tmp_path):
    for options, message in (
        ({"confidences": 0.0}, "confidences: 0 is not between 0.01 and 100"),
        ({"confidences": 1.0, "has_labels": False}, "confidences: a log without labels has no confidences"),
        ({"confidences": 1.0, "label_noise": 0.9}, r"label_noise: 0.9 is above 0.875, .* among 8 classes"),
        (
            {"confidences": 1.0, "label_noise": 0.6, "similar_errors": True},
            r"label_noise: 0.6 is above 0.5, .* among 2 classes",
        ),
    ):
        with pytest.raises(ConfigError, match=message):
            SimulationConfig(**options)
    assert_fails(2, "confidences: a log without", "simulate", tmp_path / "a", "--no-labels", "--confidences", "1")


def test_the_command_writes_confidences(calibrated, tmp_path):
    size = ("--robots", 1, "--duration", 4, "--rate", 4, "--image", "80x60", "--seed", 5, "--world-size", 24)
    octoreplay("simulate", "team", *size, "--label-noise", 0.3, "--depth-noise", 0, "--confidences", 1, folder=tmp_path)
    assert (tmp_path / "team" / "husky_1.mcap").read_bytes() == (calibrated / "husky_1.mcap").read_bytes()
