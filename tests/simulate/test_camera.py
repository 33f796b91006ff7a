"""Tests of rendered images and their noise."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.errors import InputError
from octoreplay.records import CameraModel
from octoreplay.simulate.camera import (
    LabelPatches,
    MeshCamera,
    add_depth_noise,
    add_label_noise,
    depth_noise_sigma,
    depth_to_millimetres,
)
from octoreplay.simulate.scene import NO_LABEL
from octoreplay.simulate.world import (
    BUILDING,
    CAR,
    DIRT_ROAD,
    FENCE,
    FOLIAGE,
    GRASS,
    ROOF,
    TRUNK,
    Terrain,
    World,
    similar_classes,
)

CAMERA = CameraModel(width=9, height=7, fx=6.0, fy=5.0, cx=4.0, cy=3.0)


def two_squares() -> World:
    """World of a large square 8 m ahead on the optical axis (z) and a small square 3 m ahead at its centre."""
    points, faces = [], []
    for z, half in ((8.0, 20.0), (3.0, 0.63)):
        points += [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]
        faces += [
            (len(points) - 4, len(points) - 3, len(points) - 2),
            (len(points) - 4, len(points) - 2, len(points) - 1),
        ]
    flat = Terrain(np.zeros((1, 2)), np.zeros(1), np.zeros(1))
    classes = np.array([BUILDING, BUILDING, CAR, CAR], np.uint8)
    return World(40.0, flat, np.array(points, np.float32), np.array(faces, np.int32), classes)


def reference_images(T: np.ndarray, max_depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Reference implementation: analytic intersection of every pixel's ray with both squares."""
    depth, labels = np.zeros((CAMERA.height, CAMERA.width)), np.full((CAMERA.height, CAMERA.width), NO_LABEL)
    for v in range(CAMERA.height):
        for u in range(CAMERA.width):
            ray = T[:3, :3] @ [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0]
            for z, half, class_id in ((8.0, 20.0, BUILDING), (3.0, 0.63, CAR)):
                if ray[2] <= 0:
                    continue
                t = (z - T[2, 3]) / ray[2]
                x, y = T[0, 3] + t * ray[0], T[1, 3] + t * ray[1]
                if 0 < t <= max_depth and max(abs(x), abs(y)) < half:
                    depth[v, u], labels[v, u] = t, class_id
    return depth, labels


@pytest.mark.parametrize("max_depth", [20.0, 5.0])
@pytest.mark.parametrize(("x", "angle"), [(0.03, 0.0), (-0.4, 0.3), (1.0, -0.9), (0.0, np.pi)])
def test_images_equal_the_reference(x, angle, max_depth):
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[:3, 3] = x, 0.02, 0.1
    depth, labels = MeshCamera(two_squares(), CAMERA).take(T, max_depth)
    expected_depth, expected_labels = reference_images(T, max_depth)
    assert (depth.dtype, labels.dtype) == (np.float32, np.uint8)
    np.testing.assert_array_equal(labels, expected_labels)
    np.testing.assert_allclose(depth, expected_depth, rtol=1e-5)


def test_depth_is_along_z_and_not_along_the_ray():
    depth, _ = MeshCamera(two_squares(), CAMERA).take(np.eye(4), 20.0)
    assert depth[0, 0] == pytest.approx(8.0, abs=1e-4)
    assert depth[3, 4] == pytest.approx(3.0, abs=1e-4)


def test_noise_formula_at_known_ranges():
    np.testing.assert_allclose(depth_noise_sigma([0.4, 1.4, 10.4]), [0.0012, 0.0031, 0.1912], rtol=1e-12)


@pytest.mark.parametrize("z", [1.0, 5.0, 10.0])
def test_depth_noise_has_the_standard_deviation_of_its_range(z):
    image = np.full((200, 200), z, np.float32)
    image[:, :50] = 0.0
    noisy = add_depth_noise(image, np.random.default_rng(0))
    assert (noisy[:, :50] == 0).all()
    error = noisy[:, 50:] - z
    sigma = float(depth_noise_sigma(z))
    assert abs(error.mean()) < 5 * sigma / np.sqrt(error.size)
    assert error.std() == pytest.approx(sigma, rel=0.03)


def test_noise_keeps_measured_depths_positive():
    far = np.full((100, 100), 60.0, np.float32)
    assert (add_depth_noise(far, np.random.default_rng(1)) > 0).all()


def test_millimetres_are_rounded_and_below_65535():
    depth = np.array([[0.0, 0.0004, 0.0006, 1.2345, 65.534, 65.535, 70.0]], np.float32)
    assert depth_to_millimetres(depth).tolist() == [[0, 0, 1, 1234, 65534, 65534, 65534]]


@given(st.floats(0.0, 1.0), st.integers(2, 20), st.integers(0, 1000))
def test_label_noise_changes_the_given_share_to_other_classes(share, num_classes, seed):
    rng = np.random.default_rng(seed)
    labels = rng.integers(1, num_classes + 1, (60, 60)).astype(np.uint8)
    labels[:5] = NO_LABEL
    noisy = add_label_noise(labels, share, num_classes, rng)
    assert (noisy[:5] == NO_LABEL).all()
    changed = noisy[5:] != labels[5:]
    # Five standard deviations, plus five pixels for small counts, which are not normally distributed.
    assert abs(changed.sum() - share * changed.size) <= 5 * np.sqrt(share * (1 - share) * changed.size) + 5
    assert noisy[5:].min() >= 1
    assert noisy[5:].max() <= num_classes


def test_wrong_labels_are_uniform_over_the_other_classes():
    labels = np.full((200, 200), 3, np.uint8)
    counts = np.bincount(add_label_noise(labels, 1.0, 5, np.random.default_rng(0)).ravel(), minlength=6)
    assert counts[3] == 0
    np.testing.assert_allclose(counts[[1, 2, 4, 5]], 10_000, rtol=0.05)


def test_similar_errors_are_those_of_the_pairs_of_classes():
    similar = similar_classes()
    assert [(similar[other], other) for other in (DIRT_ROAD, ROOF, FOLIAGE, CAR)] == [
        (GRASS, DIRT_ROAD),
        (BUILDING, ROOF),
        (TRUNK, FOLIAGE),
        (FENCE, CAR),
    ]
    labels = np.random.default_rng(0).integers(1, 9, (300, 300)).astype(np.uint8)
    labels[:9] = NO_LABEL
    noisy = add_label_noise(labels, 0.2, 8, np.random.default_rng(1), similar)
    changed = noisy != labels
    assert not changed[:9].any()
    assert abs(changed[9:].mean() - 0.2) < 0.01
    np.testing.assert_array_equal(noisy[changed], similar[labels[changed]])
    # Kinds of a class resemble the same kind of the other class.
    assert similar_classes(3)[1:7].tolist() == [4, 5, 6, 1, 2, 3]


def test_patches_with_similar_errors_have_the_similar_class_everywhere():
    similar = similar_classes()
    points = np.random.default_rng(0).uniform(-50.0, 50.0, (200, 200, 3))
    labels = np.full((200, 200), BUILDING, np.uint8)
    labels[0] = NO_LABEL
    patchy = LabelPatches(0.3, 8, np.random.default_rng(0), similar).apply(labels, points)
    assert set(np.unique(patchy)) == {NO_LABEL, BUILDING, ROOF}
    assert abs((patchy == ROOF).mean() - 0.3) < 0.02


def test_a_missing_open3d_is_reported_with_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match=r"needs Open3D.*apt-get install libusb-1\.0-0 libegl1 libgl1 libx11-6"):
        MeshCamera(two_squares(), CAMERA)
