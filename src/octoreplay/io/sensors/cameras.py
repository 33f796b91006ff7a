"""Camera models from calibrations: rectified or distorted, with binning and a region of interest."""

from __future__ import annotations

import math
import re
from functools import lru_cache

import cv2
import numpy as np
from numpy.polynomial import Polynomial

from octoreplay.errors import InputError
from octoreplay.io.messages.sensor_messages import Calibration
from octoreplay.io.sensors.images import MAX_PIXELS
from octoreplay.records import CameraModel, Float32Array, Float64Array, read_only

POLYNOMIAL_MODELS = ("plumb_bob", "rational_polynomial")
FISHEYE_MODELS = ("equidistant", "fisheye", "kannala_brandt")
"""Distortion models by their names in ROS and Foxglove; the formulas are OpenCV's."""

# No lens has coefficients above the first; polynomial coefficients below the second have no effect.
_MAX_COEFFICIENT, _NEGLIGIBLE = 1e6, 1e-12
# A pixel is outside the lens model's range where its distorted ray misses it by more than this.
_MAX_ERROR_PIXELS = 0.05
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)


def camera_model(calibration: Calibration, where: str, *, is_rectified: bool) -> CameraModel:
    """Return the camera model of an image: pinhole by P where the image is rectified, else by K and D.

    Binning and the region of interest are applied as in ROS's image_geometry: the region is cut out of the full image
    first. Rays of a distorting lens are computed once (``CameraModel.slopes``), with NaN for pixels that no ray of the
    lens model hits. Raises InputError for a camera without calibration and for an unknown distortion model.
    """
    matrix = check_camera(calibration, where, is_rectified=is_rectified)
    width, height = image_size(calibration)
    slopes = None
    if _distorts(calibration, is_rectified):
        lens = calibration.model, tuple(calibration.D.tolist())
        slopes = _rays(*lens, tuple(matrix.ravel().tolist()), width, height)
    fx, fy, cx, cy = (float(number) for number in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    return CameraModel(width, height, fx, fy, cx, cy, slopes)


def check_camera(calibration: Calibration, where: str, *, is_rectified: bool) -> Float64Array:
    """Return the camera matrix (3, 3) of the images [pixels]; raises as ``camera_model`` does.

    No rays are computed, so that a calibration of a wrong image size takes no memory.
    """
    has_projection = is_rectified and calibration.P[0, 0] > 0 and calibration.P[1, 1] > 0
    matrix = (calibration.P[:, :3] if has_projection else calibration.K).copy()
    if not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise InputError(f"{where}: the camera is not calibrated (K is zero); give intrinsics: [fx, fy, cx, cy]")
    matrix[0, 2] -= calibration.roi[0]
    matrix[1, 2] -= calibration.roi[1]
    matrix[0] /= calibration.binning[0]
    matrix[1] /= calibration.binning[1]
    if _distorts(calibration, is_rectified):
        _check_lens(calibration, where)
    return matrix


def has_rectified_name(topic: str) -> bool:
    """Return True for a topic of rectified images by its name."""
    return re.search(r"(^|[/_])rect", topic.lower()) is not None


def image_size(calibration: Calibration) -> tuple[int, int]:
    """Return width and height of a calibration's images, binning and region of interest applied [pixels]."""
    _, _, width, height = calibration.roi
    binning = calibration.binning
    return (width or calibration.width) // binning[0], (height or calibration.height) // binning[1]


def _distorts(calibration: Calibration, is_rectified: bool) -> bool:
    """True where the images have lens distortion."""
    return not is_rectified and bool(np.any(calibration.D != 0))


def _check_lens(calibration: Calibration, where: str) -> None:
    """Raise InputError for a lens whose rays cannot be computed."""
    D, (width, height) = calibration.D, image_size(calibration)
    if not 0 < width * height <= MAX_PIXELS:
        raise InputError(f"{where}: the camera's image cannot be {width}x{height} pixels; give intrinsics")
    if not (np.abs(D) <= _MAX_COEFFICIENT).all():
        raise InputError(
            f"{where}: the distortion coefficients {D.tolist()} are out of range; give intrinsics: [fx, fy, cx, cy]"
        )
    if not (calibration.model in POLYNOMIAL_MODELS and D.size in (4, 5, 8, 12, 14)) and not (
        calibration.model in FISHEYE_MODELS and D.size == 4
    ):
        raise InputError(
            f"{where}: the camera has distortion of the model '{calibration.model}' with {D.size} coefficients, which "
            f"is not supported ({', '.join((*POLYNOMIAL_MODELS, *FISHEYE_MODELS))} are); use a rectified depth image, "
            f"or give intrinsics: [fx, fy, cx, cy] to ignore it"
        )


@lru_cache(maxsize=8)
def _rays(
    model: str, coefficients: tuple[float, ...], numbers: tuple[float, ...], width: int, height: int
) -> Float32Array:
    """Slopes x / z and y / z of every pixel, (2, height, width); NaN where the lens model has no ray."""
    D, matrix = np.array(coefficients), np.array(numbers).reshape(3, 3)
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
    if model in FISHEYE_MODELS:
        rays = cv2.fisheye.undistortPoints(pixels, matrix, D, criteria=_CRITERIA)
        again = cv2.fisheye.distortPoints(rays, matrix, D)
        k1, k2, k3, k4 = coefficients
        angle = _monotonic_limit(Polynomial([0, 1, 0, k1, 0, k2, 0, k3, 0, k4]), Polynomial([1]))
        widest = math.tan(angle) if angle < math.pi / 2 else math.inf
    else:
        rays = cv2.undistortPoints(pixels, matrix, D, criteria=_CRITERIA)
        ahead = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)
        again, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), matrix, D)
        k1, k2, k3, k4, k5, k6 = np.pad(D, (0, 8))[[0, 1, 4, 5, 6, 7]]
        widest = _monotonic_limit(Polynomial([0, 1, 0, k1, 0, k2, 0, k3]), Polynomial([1, 0, k4, 0, k5, 0, k6]))
    error = np.abs(np.reshape(again, (-1, 2)) - pixels[:, 0]).max(axis=1)
    flat = np.reshape(rays, (-1, 2))
    with np.errstate(over="ignore", invalid="ignore"):
        is_real = (error <= _MAX_ERROR_PIXELS) & (np.hypot(flat[:, 0], flat[:, 1]) <= widest)
        slopes = np.where(is_real[:, None], flat, np.nan).astype(np.float32)
    slopes = np.ascontiguousarray(slopes.T.reshape(2, height, width))
    # The cached array is shared by all cameras with the same lens.
    return read_only(slopes)


def _monotonic_limit(numerator: Polynomial, denominator: Polynomial) -> float:
    """Largest ray parameter up to which a lens model's image radius increases.

    Beyond it several rays fall on one pixel, and only the one within the limit is real.
    """
    slope = numerator.deriv() * denominator - numerator * denominator.deriv()
    roots = np.concatenate([poly.trim(_NEGLIGIBLE).roots() for poly in (slope, denominator)])
    turns = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(turns.min(initial=math.inf))
