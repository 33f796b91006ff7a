"""Colour images of a mesh: class colours with texture, sunlight, shadows, haze and the noise of a sensor."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octoreplay.records import ClassTable, Float32Array, Float64Array, UInt8Array
from octoreplay.simulate.camera import MeshCamera
from octoreplay.simulate.scene import NO_LABEL

COLOUR_FORMATS = ("raw", "jpeg", "png")
"""Forms in which colour images are recorded: sensor_msgs/Image (rgb8), or CompressedImage."""

_SKY = (158, 190, 224)
_AMBIENT, _SUN = 0.45, 0.55
_HAZE_LENGTH = 120.0
_TEXTURES = ((0.04, 0.08), (0.3, 0.10), (2.5, 0.10))
"""Edge [m] of each texture's cubes, and the standard deviation of the reflectance in them, relative."""
_TINT = 0.04
_EXPOSURE = 0.08
_NOISE = 4.0
_SHADOW_OFFSET = 0.02


class ColourCamera:
    """Colour camera of one robot.

    The colour of a point is that of its class, times a texture that is fixed in space, times ambient light and, where
    the sun shines on it, Lambert's cosine; haze mixes it with the sky over distance. Each image has an exposure of its
    own and independent noise of every pixel. Sun and texture depend on ``seed`` alone, the rest also on the robot.
    """

    def __init__(self, camera: MeshCamera, class_table: ClassTable, seed: int, robot_index: int) -> None:
        self._camera = camera
        palette = np.full((256, 3), _SKY, dtype=np.float32)
        palette[1 : class_table.num_classes + 1] = class_table.colors
        self._palette = palette
        self._seed = seed
        azimuth, elevation = np.random.default_rng([seed, 10]).uniform((-np.pi, 0.6), (np.pi, 1.1))
        horizontal = np.cos(elevation)
        self._sun = np.array([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)])
        self._rng = np.random.default_rng([seed, 9, robot_index])

    def take(self, T_world_camera: Float64Array) -> UInt8Array:
        """Render an image (H, W, 3) uint8 red, green, blue from a pose (4, 4) of the optical frame."""
        points, labels, normals = self._camera.take_surfaces(T_world_camera)
        lit = np.maximum(normals @ self._sun, 0.0)
        lit[self._camera.is_occluded(points + _SHADOW_OFFSET * normals, self._sun)] = 0.0
        light = (_AMBIENT + _SUN * lit)[..., None]
        colors = self._palette[labels] * light * self._texture(points)
        distance = np.linalg.norm(points - T_world_camera[:3, 3], axis=-1, keepdims=True)
        clear = np.exp(-distance / _HAZE_LENGTH)
        colors = clear * colors + (1.0 - clear) * np.array(_SKY)
        colors[labels == NO_LABEL] = _SKY
        colors *= np.exp(_EXPOSURE * self._rng.standard_normal())
        colors += _NOISE * self._rng.standard_normal(colors.shape, dtype=np.float32)
        image: UInt8Array = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
        return image

    def _texture(self, points: Float64Array) -> Float32Array:
        """Reflectance (H, W, 3) relative to the class's colour at points (H, W, 3) [m]."""
        texture = np.ones(points.shape, dtype=np.float32)
        for number, (edge, sigma) in enumerate(_TEXTURES):
            cells = np.floor(points / edge).astype(np.int64)
            values = [_hashed(cells, self._seed, 4 * number + channel) for channel in range(4)]
            # One value for all channels and a smaller one for each.
            for channel in range(3):
                texture[..., channel] *= 1.0 + sigma * values[3] + _TINT * values[channel]
        return np.maximum(texture, np.float32(0.0))


def _hashed(cells: npt.NDArray[np.int64], seed: int, stream: int) -> Float32Array:
    """Reproducible numbers (H, W) of mean 0 and standard deviation 1, uniform, for integer cells (H, W, 3)."""
    bits = cells.astype(np.uint64)
    mixed = np.full(cells.shape[:-1], (seed * 64 + stream) & 0xFFFFFFFF, dtype=np.uint64)
    for axis in range(3):
        # The finaliser of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014) after each coordinate.
        mixed += bits[..., axis] + np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    unit = (mixed >> np.uint64(40)).astype(np.float32) / np.float32(1 << 24)
    return np.asarray((unit - np.float32(0.5)) * np.float32(np.sqrt(12.0)), dtype=np.float32)
