"""Depth and label images of a mesh by ray casting, and the noise of a depth camera."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octoreplay.records import BoolArray, CameraModel, Float32Array, Float64Array, Int64Array, UInt8Array
from octoreplay.simulate.scene import NO_LABEL, MeshScene
from octoreplay.simulate.world import World

_FAR = 1000.0
_PATCH_EDGE = 2.0
PATCH_GRID = (64, 64, 16)
"""Number of cubes along each axis in the grid of places with properties of their own."""


class MeshCamera:
    """Camera that renders depth and label images of a world.

    Raises InputError if Open3D or one of its shared libraries is missing.
    """

    def __init__(self, world: World, camera: CameraModel) -> None:
        self._scene = MeshScene(world)
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        self._rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)

    def take(self, T_world_camera: Float64Array, max_depth: float) -> tuple[Float32Array, UInt8Array]:
        """Render depth (H, W) float32 [m] along z, 0 beyond ``max_depth`` [m], and labels (H, W) uint8.

        ``T_world_camera`` (4, 4) is the pose of the optical frame: z forward, x right, y down.
        """
        depth, labels, _ = self._cast(T_world_camera)
        beyond = ~(depth <= max_depth)
        depth[beyond] = 0.0
        labels[beyond] = NO_LABEL
        return depth, labels

    def take_surfaces(self, T_world_camera: Float64Array) -> tuple[Float64Array, UInt8Array, Float32Array]:
        """Return the surfaces in view: points (H, W, 3) [m] and unit normals (H, W, 3) in the world, and labels (H, W).

        Normals point to the camera's side. Where a ray hits nothing the label is NO_LABEL and the point is far away.
        """
        depth, labels, normals = self._cast(T_world_camera)
        depth[~np.isfinite(depth)] = _FAR
        points = self.points(depth, T_world_camera)
        towards = ((T_world_camera[:3, 3] - points) * normals).sum(axis=-1, keepdims=True)
        return points, labels, np.where(towards < 0, -normals, normals).astype(np.float32)

    def is_occluded(self, points: Float64Array, direction: Float64Array) -> BoolArray:
        """Return True (H, W) where a surface lies in a direction (3,) from points (H, W, 3)."""
        return self._scene.is_occluded(points, direction)

    def _cast(self, T_world_camera: Float64Array) -> tuple[Float32Array, UInt8Array, Float32Array]:
        """Depth (H, W) along z, infinite where nothing is hit, labels (H, W) and unit normals (H, W, 3)."""
        # The z component of each ray is 1, so that the returned distance is the depth along z.
        return self._scene.cast(T_world_camera[:3, 3], self._rays @ T_world_camera[:3, :3].T)

    def points(self, depth: Float32Array, T_world_camera: Float64Array) -> Float64Array:
        """Return the world coordinates (H, W, 3) [m] of a depth image's pixels."""
        points: Float64Array = (depth[..., None] * self._rays) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        return points


def patch_cells(points: Float64Array) -> tuple[Int64Array, ...]:
    """Return the indices of the cubes in ``PATCH_GRID`` that hold ``points`` (H, W, 3) [m], three arrays (H, W)."""
    # The grid repeats itself beyond its edges.
    return tuple(np.moveaxis(np.mod(np.floor(points / _PATCH_EDGE).astype(np.int64), PATCH_GRID), -1, 0))


class LabelPatches:
    """Places at which a robot's network gives a wrong class: cubes of space that keep their error in every image.

    In a ``share`` of the cubes the classes are shifted cyclically by a number that is drawn for the cube, or replaced
    by their ``similar`` classes (C + 1,) uint8 where these are given. Errors of this kind do not average out over
    images.
    """

    def __init__(
        self, share: float, num_classes: int, rng: np.random.Generator, similar: UInt8Array | None = None
    ) -> None:
        wrong = rng.random(PATCH_GRID) < share
        self._shifts = np.where(wrong, rng.integers(1, num_classes, PATCH_GRID), 0)
        self._num_classes = num_classes
        self._similar = similar

    def apply(self, labels: UInt8Array, points: Float64Array) -> UInt8Array:
        """Return the label image (H, W) with the errors at ``points`` (H, W, 3), the pixels' world coordinates [m]."""
        shifts = self._shifts[patch_cells(points)]
        if self._similar is not None:
            return np.where((labels == NO_LABEL) | (shifts == 0), labels, _similar_labels(labels, self._similar))
        shifted = (labels.astype(np.int64) - 1 + shifts) % self._num_classes + 1
        return np.where(labels == NO_LABEL, labels, shifted).astype(np.uint8)


def depth_noise_sigma(depth: npt.ArrayLike) -> Float64Array:
    """Return the standard deviation [m] of a depth camera's noise at depths [m].

    sigma(z) = 0.0012 + 0.0019 (z - 0.4)^2 (Nguyen, Izadi and Lovell, Modeling Kinect Sensor Noise for Improved 3D
    Reconstruction and Tracking, 3DIMPVT 2012).
    """
    sigma: Float64Array = 0.0012 + 0.0019 * (np.asarray(depth, dtype=np.float64) - 0.4) ** 2
    return sigma


def add_depth_noise(depth: Float32Array, rng: np.random.Generator, factor: float = 1.0) -> Float32Array:
    """Return the depth image [m] with Gaussian noise of ``factor`` * sigma(z); pixels without a measurement stay 0."""
    noise = np.float32(factor) * rng.standard_normal(depth.shape, dtype=np.float32)
    noisy = depth + noise * depth_noise_sigma(depth).astype(np.float32)
    return np.where(depth > 0, np.maximum(noisy, np.float32(0.001)), np.float32(0.0))


def depth_to_millimetres(depth: Float32Array) -> npt.NDArray[np.uint16]:
    """Convert a depth image [m] to uint16 millimetres, at most 65534, because 65535 often means 'invalid'."""
    millimetres: npt.NDArray[np.uint16] = np.clip(np.rint(depth * np.float32(1000.0)), 0, 65534).astype(np.uint16)
    return millimetres


def add_label_noise(
    labels: UInt8Array,
    share: float | Float64Array,
    num_classes: int,
    rng: np.random.Generator,
    similar: UInt8Array | None = None,
) -> UInt8Array:
    """Return the label image with this share of its measured pixels changed to another class.

    ``share`` may also be the probability of each pixel (H, W). The other class is drawn uniformly, or is the
    ``similar`` one of each class (C + 1,) uint8 where these are given.
    """
    wrong = (rng.random(labels.shape, dtype=np.float32) < share) & (labels != NO_LABEL)
    if similar is not None:
        return np.where(wrong, _similar_labels(labels, similar), labels)
    noisy = labels.copy()
    # Adding 1 to C - 1 modulo C gives each other class with equal probability.
    shift = rng.integers(1, num_classes, int(wrong.sum()), dtype=np.int64)
    noisy[wrong] = (labels[wrong].astype(np.int64) - 1 + shift) % num_classes + 1
    return noisy


def _similar_labels(labels: UInt8Array, similar: UInt8Array) -> UInt8Array:
    """Similar class of each label (H, W); pixels without a label get any."""
    found: UInt8Array = similar[np.minimum(labels, similar.size - 1)]
    return found
