"""Depth and label images of datasets: PNG in several encodings, NumPy arrays and tables of ranges."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.io.sensors.images import UNREADABLE, most_pixels
from octoreplay.records import Float32Array

_MAX_RANGES = 1 << 26
"""Largest number of ranges in a text file."""
_BYTES_PER_RANGE = 64
"""Largest number of bytes that a text file may have for each of its ranges."""


def read_png(path: Path) -> npt.NDArray[Any]:
    """Return the pixels of a PNG: (H, W) uint8 or uint16 for grey ones. Raises InputError for another file."""
    from PIL import Image, UnidentifiedImageError

    try:
        # Pillow has a limit of its own, of which it warns. Other formats have decoders that were not tested here.
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=("PNG",)) as image:
            if image.width * image.height > most_pixels(path.stat().st_size):
                raise InputError(f"{path}: an image of {image.width}x{image.height} pixels is too large to decode")
            if image.mode.startswith("I"):
                # Older Pillow opens 16-bit grey as 32-bit integers.
                return np.asarray(image).astype(np.uint16)
            return np.asarray(image)
    except FileNotFoundError as error:
        raise InputError(f"{path}: not found") from error
    except UnidentifiedImageError as error:
        raise InputError(f"{path}: is not a PNG image") from error
    except (*UNREADABLE, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: is damaged: {error}") from error


def kind_of_image(image: npt.NDArray[Any]) -> str:
    """Return the type of an image, as a clause of an error."""
    return f"{image.dtype.itemsize * 8} bits in {1 if image.ndim == 2 else image.shape[2]} channels"


def read_depth_png(path: Path) -> npt.NDArray[np.uint16]:
    """Return a 16-bit grey PNG, (H, W) uint16. Raises InputError for another file."""
    raw = read_png(path)
    if raw.dtype != np.uint16:
        raise InputError(f"{path}: a depth image must be a 16-bit grey PNG, this one has {kind_of_image(raw)}")
    return raw


def read_rotated_png(path: Path) -> npt.NDArray[np.uint16]:
    """Return a depth PNG of SUN3D, (H, W) uint16 in mm. Raises InputError as ``read_depth_png``.

    Its values are rotated by three bits to the left, so that viewers show them brighter
    (https://github.com/PrincetonVision/SUN3Dsfm).
    """
    raw = read_depth_png(path)
    return (raw >> np.uint16(3)) | (raw << np.uint16(13))


def read_depth_npy(path: Path) -> Float32Array:
    """Return a depth image in a NumPy file, (H, W) or (H, W, 1) of floats, as (H, W) float32 in metres.

    Raises InputError for another file.
    """
    try:
        depth = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: is damaged, or not a NumPy file of numbers: {error}") from error
    if not isinstance(depth, np.ndarray) or depth.dtype.kind != "f" or depth.ndim - (depth.shape[-1:] == (1,)) != 2:
        raise InputError(f"{path}: a depth image must be an array (H, W) of floats in metres")
    with np.errstate(over="ignore"):
        return np.array(depth.reshape(depth.shape[:2]), np.float32)


def read_ranges(path: Path, size: tuple[int, int], intrinsics: Sequence[float]) -> Float32Array:
    """Return the depths of a text file of ranges along the rays [m] as (H, W) float32 in metres.

    ``size`` is (W, H), ``intrinsics`` (fx, fy, cx, cy) in pixels. The depth is the range over
    sqrt(((u - cx) / fx)^2 + ((v - cy) / fy)^2 + 1) (https://www.doc.ic.ac.uk/~ahanda/VaFRIC/codes.html). Raises
    InputError where the file does not hold one number for each pixel.
    """
    width, height = size
    fx, fy, cx, cy = intrinsics
    try:
        if width * height > _MAX_RANGES or path.stat().st_size > _BYTES_PER_RANGE * width * height:
            raise InputError(f"{path}: is too large for {width}x{height} ranges")
        ranges = np.array(path.read_text(encoding="ascii").split(), np.float64)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"{path}: expects {width * height} ranges as numbers") from error
    if ranges.size != width * height:
        raise InputError(f"{path}: has {ranges.size} numbers; {width}x{height} ranges are expected")
    u, v = (np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy
    with np.errstate(over="ignore", invalid="ignore"):
        depth = ranges.reshape(height, width) / np.sqrt(u**2 + v[:, None] ** 2 + 1.0)
        return depth.astype(np.float32)
