"""Image messages to depth and label arrays, CameraInfo to a camera model."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import DamagedMessageError
from octoreplay.records import CameraModel

DEPTH_ENCODINGS = {"16UC1": ("u2", 0.001), "mono16": ("u2", 0.001), "32FC1": ("f4", 1.0)}
"""Depth encodings: element type, and metres per unit (REP 118)."""

LABEL_ENCODINGS = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "16SC1": "i2", "32SC1": "i4"}
"""Label encodings: element type."""


def decode_depth(image: Any, where: str) -> tuple[npt.NDArray[Any], float]:
    """The depth image (H, W), uint16 or float32, and its unit: metres along z = value x unit.

    ``image`` is a sensor_msgs/Image; ``where`` begins the errors. The array is C-contiguous, aligned and in native byte
    order; it is a view of the message where its bytes allow that. Source of the units: REP 118.
    Raises InputError for another encoding, DamagedMessageError where there are fewer bytes than the size says.
    """
    try:
        kind, unit = DEPTH_ENCODINGS[image.encoding]
    except KeyError:
        raise InputError(
            f"{where}: image encoding '{image.encoding}' holds no depth; {', '.join(DEPTH_ENCODINGS)} can be read"
        ) from None
    return _pixels(image, kind, where), unit


def decode_labels(image: Any, where: str) -> npt.NDArray[Any]:
    """The raw labels of a label image: (H, W), uint8, uint16, int16 or int32.

    As ``decode_depth`` otherwise. Raises InputError for another encoding, DamagedMessageError for too few bytes.
    """
    try:
        kind = LABEL_ENCODINGS[image.encoding]
    except KeyError:
        raise InputError(
            f"{where}: image encoding '{image.encoding}' holds no labels; {', '.join(LABEL_ENCODINGS)} can be read"
        ) from None
    return _pixels(image, kind, where)


def _pixels(image: Any, kind: str, where: str) -> npt.NDArray[Any]:
    """One-channel pixels (H, W), without the rows' padding, native and aligned."""
    height, width, step = int(image.height), int(image.width), int(image.step)
    dtype = np.dtype((">" if image.is_bigendian else "<") + kind)
    row_bytes = width * dtype.itemsize
    if height < 1 or width < 1 or step < row_bytes:
        raise DamagedMessageError(
            f"{where}: an image of {width}x{height} {image.encoding} cannot have rows of {step} bytes"
        )
    # The last row may come without its padding.
    if len(image.data) < step * (height - 1) + row_bytes:
        raise DamagedMessageError(
            f"{where}: the image holds {len(image.data)} bytes, but {height} rows of {step} bytes are announced"
        )
    pixels = np.ndarray((height, width), dtype, buffer=image.data, strides=(step, dtype.itemsize))
    native = pixels.astype(dtype.newbyteorder("="), copy=False)
    return np.require(native, requirements=["C", "A"])


def camera_model(info: Any, where: str) -> CameraModel:
    """The pinhole model of a sensor_msgs/CameraInfo (ROS 1 or 2), from its K.

    Raises InputError for an uncalibrated camera (K is zero) and for one with distortion: depth is read as rectified.
    """
    # ROS 1 writes these names in capitals.
    matrix = np.asarray(getattr(info, "k", None) if hasattr(info, "k") else info.K, dtype=np.float64)
    distortion = np.asarray(getattr(info, "d", None) if hasattr(info, "d") else info.D, dtype=np.float64)
    fx, cx, fy, cy = matrix[0], matrix[2], matrix[4], matrix[5]
    if not np.isfinite(matrix).all() or fx <= 0 or fy <= 0:
        raise InputError(f"{where}: the camera is not calibrated (K is zero); give intrinsics: [fx, fy, cx, cy]")
    if np.any(distortion != 0):
        raise InputError(
            f"{where}: the camera has distortion (model '{info.distortion_model}'), which is not supported; "
            f"use a rectified depth image, or give intrinsics: [fx, fy, cx, cy] to ignore it"
        )
    return CameraModel(int(info.width), int(info.height), float(fx), float(fy), float(cx), float(cy))


def check_same_size(image: npt.NDArray[Any], camera: CameraModel, where: str) -> None:
    """Raise InputError where an image has another size than its CameraInfo says."""
    height, width = image.shape
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{where}: the image is {width}x{height}, but its CameraInfo is for {camera.width}x{camera.height}; "
            f"name the right camera_info_topic or give intrinsics: [fx, fy, cx, cy]"
        )
