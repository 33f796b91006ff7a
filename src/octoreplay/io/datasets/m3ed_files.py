"""HDF5 files of M3ED: depth images of the left event camera with their times and poses, and its calibration.

Sources: https://github.com/daniilidis-group/m3ed, build_system/lidar_depth/fasterlio_gt.py (depth file),
build_system/bag_processing/rosbag2hdf5.py (calibration); https://m3ed.io/data_overview/datafiles.

h5py is an optional dependency: ``pip install 'octoreplay[h5]'``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.robots.robot_log_writer import OPTICAL_IN_BODY
from octoreplay.io.robots.trajectories import rigid
from octoreplay.io.sensors.images import MAX_PIXELS, most_pixels
from octoreplay.records import Float32Array, Float64Array
from octoreplay.transforms import inverse

DEPTH_SUFFIX = "_depth_gt.h5"
"""End of the name of a sequence's depth file."""

_IMAGES = "depth/prophesee/left"
_CALIBRATION = "prophesee/left/calib"
_MAX_FRAMES = 1 << 20
_UNREADABLE = (OSError, RuntimeError, LookupError, ValueError, TypeError, MemoryError)
"""Errors of h5py for damaged files."""


@dataclass(frozen=True, eq=False)
class M3edTrack:
    """Frames of a depth file: stamps [ns] and T_map_camera, None where a pose is not finite.

    ``images`` are paths FILE/DATASET/NUMBER for ``read_depth_h5``.
    """

    stamps: list[int]
    poses: list[Float64Array | None]
    images: list[Path]


@dataclass(frozen=True)
class M3edCamera:
    """Calibration of a camera: (fx, fy, cx, cy) and (W, H) in pixels, and the coefficients k1, k2, p1, p2, k3."""

    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    distortion: tuple[float, float, float, float, float]


def calibration_file(depth_file: Path) -> Path:
    """Return the path of the file with the calibration of a depth file's sequence, SEQUENCE_data.h5."""
    return depth_file.with_name(f"{depth_file.name.removesuffix(DEPTH_SUFFIX)}_data.h5")


def read_track(path: Path) -> M3edTrack:
    """Return the frames of a depth file. Raises InputError for a damaged file, ConfigError without h5py.

    Times in ``ts`` are microseconds. ``Cn_T_C0`` maps the first camera's coordinates to the frame's camera. The map
    has the first camera's position, with x forward, y left and z up in that camera.
    """
    with _opened(path) as file:
        times = _array(file, path, "ts", (None,), "iuf")[()]
        count = len(times)
        matrices = _array(file, path, "Cn_T_C0", (count, 4, 4), "f")[()].astype(np.float64)
        _depth_images(file, path, count)
    if not np.isfinite(times).all():
        raise InputError(f"{path}: 'ts' has times that are not finite")
    T_map_first = np.eye(4)
    T_map_first[:3, :3] = OPTICAL_IN_BODY
    poses = [
        T_map_first @ inverse(rigid(f"{path}: Cn_T_C0 row {k}", T)) if np.isfinite(T).all() else None
        for k, T in enumerate(matrices)
    ]
    stamps = [round(time) * 1000 for time in times.tolist()]
    return M3edTrack(stamps, poses, [path / _IMAGES / f"{k:06d}" for k in range(count)])


def read_camera(path: Path) -> M3edCamera:
    """Return the calibration of the left event camera. Raises InputError for a damaged file, ConfigError without h5py.

    The authors project points with OpenCV's polynomial model, and store the depth of a point at (u, v) in the pixel
    (floor u, floor v). The centre of a pixel is therefore at u + 0.5, and cx and cy are returned lower by 0.5.
    """
    with _opened(path) as file:
        fx, fy, cx, cy = _array(file, path, f"{_CALIBRATION}/intrinsics", (4,), "f")[()].tolist()
        k1, k2, p1, p2 = _array(file, path, f"{_CALIBRATION}/distortion_coeffs", (4,), "f")[()].tolist()
        width, height = _array(file, path, f"{_CALIBRATION}/resolution", (2,), "iu")[()].tolist()
    if not np.isfinite((fx, fy, cx, cy, k1, k2, p1, p2)).all() or min(fx, fy) <= 0:
        raise InputError(f"{path}: '{_CALIBRATION}' is not a camera: numbers must be finite, focal lengths above 0")
    return M3edCamera((fx, fy, cx - 0.5, cy - 0.5), (width, height), (k1, k2, p1, p2, 0.0))


def read_depth_h5(image: Path) -> Float32Array:
    """Return the depth image at a path FILE/DATASET/NUMBER, (H, W) float32 in metres; infinite without a point.

    Raises InputError for a damaged file.
    """
    path = image.parents[_IMAGES.count("/") + 1]
    with _opened(path) as file:
        images = _depth_images(file, path, None)
        index = int(image.name)
        if images.chunks is not None:
            stored = images.id.get_chunk_info_by_coord((index, 0, 0)).size
            if stored > 2 * prod(images.chunks) * images.dtype.itemsize:
                raise InputError(f"{image}: is damaged: {stored} bytes are stored for one image")
        return np.asarray(images[index], np.float32)


def _depth_images(file: Any, path: Path, count: int | None) -> Any:
    """Dataset of the depth images, each of them contiguous or one chunk."""
    images = _array(file, path, _IMAGES, (count, None, None), "f")
    height, width = images.shape[1:]
    if not 0 < height * width <= most_pixels(path.stat().st_size):
        raise InputError(f"{path}: '{_IMAGES}': images of {width}x{height} pixels are empty or too large for the file")
    if images.chunks not in (None, (1, height, width)):
        raise InputError(f"{path}: '{_IMAGES}': chunks of {images.chunks} values; expects one image in a chunk")
    return images


def _array(file: Any, path: Path, name: str, shape: tuple[int | None, ...], kinds: str) -> Any:
    """Dataset of a file with numbers of some kinds and a shape, in which None stands for any size."""
    if name not in file:
        raise InputError(f"{path}: has no dataset '{name}'; expects a file of M3ED")
    found = file[name]
    if not hasattr(found, "chunks") or found.is_virtual or found.external or found.file.filename != file.filename:
        raise InputError(f"{path}: '{name}' is not a dataset inside this file")
    if found.dtype.kind not in kinds or found.dtype.itemsize > 8:
        raise InputError(f"{path}: '{name}' has values of type {found.dtype}; it is not a file of M3ED")
    is_expected = len(found.shape) == len(shape) and all(
        size in (None, own) for size, own in zip(shape, found.shape, strict=True)
    )
    if not is_expected or not 0 < found.shape[0] <= _MAX_FRAMES:
        expected = " x ".join("N" if size is None else str(size) for size in shape)
        raise InputError(f"{path}: '{name}' has the shape {found.shape}; expects {expected}, N up to {_MAX_FRAMES}")
    if found.chunks is not None and prod(found.chunks) > MAX_PIXELS:
        raise InputError(f"{path}: '{name}' has chunks of {found.chunks} values, which are too large")
    if found.compression not in (None, "lzf"):
        raise InputError(f"{path}: '{name}' is compressed with {found.compression}; expects lzf, as published")
    return found


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open an HDF5 file, and turn the errors of h5py into InputError."""
    try:
        import h5py
    except ImportError as error:
        raise ConfigError(
            "M3ED's HDF5 files need the package h5py; install it with: pip install 'octoreplay[h5]'"
        ) from error
    try:
        with h5py.File(path, "r", locking=False) as file:
            yield file
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: not found") from error
    except _UNREADABLE as error:
        raise InputError(f"{path}: is damaged, or not an HDF5 file: {str(error).partition(chr(10))[0]}") from error
