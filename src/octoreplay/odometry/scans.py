"""Measurements as odometry needs them: clouds with the time of each point, depth images with their colours."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.config.robot import RobotConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import RawMessage
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Cloud, CompressedImage, Image, Scan
from octoreplay.io.robots.frame_maker import CloudFrameMaker, DepthFrameMaker
from octoreplay.io.robots.frame_queue import Settled
from octoreplay.io.sensors.clouds import decode_cloud, decode_scan
from octoreplay.io.sensors.images import decode_labels
from octoreplay.io.sensors.labels import LabelLookup
from octoreplay.records import BodyBox, CloudFrame, DepthFrame, Float64Array, UInt8Array

# A sweep takes between these times [s]; they differ by less than the factor between two units of time.
_SHORTEST_SWEEP, _LONGEST_SWEEP = 0.002, 1.999
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)


@dataclass(frozen=True, eq=False)
class TimedCloud(CloudFrame):
    """Cloud with the time of each point after the cloud's stamp, (P,) float64 [s]; None where it has none."""

    times: Float64Array | None = None

    @property
    def middle(self) -> float:
        """Time of the middle of the sweep after the stamp [s]; 0 where the points have no times."""
        return 0.0 if self.times is None else float(self.times.min() + self.times.max()) / 2.0


@dataclass(frozen=True, eq=False)
class ColoredDepth(DepthFrame):
    """Depth image with the colours of its pixels, (H, W, 3) uint8 RGB; None without a colour camera."""

    colors: UInt8Array | None = None


class TimedCloudMaker(CloudFrameMaker):
    """Decoder of point clouds and laser scans with the times of their points."""

    def make(
        self, settled: Settled[RawMessage], stamp_ns: int, T_team_sensor: Float64Array, boxes: tuple[BodyBox, ...]
    ) -> TimedCloud:
        """Return the cloud of a message, with its points in the frame of the message's header."""
        message = settled.message
        found = message.sensor_message()
        times = None
        if isinstance(found, Scan):
            points, T_frame_points = decode_scan(found).points, found.T_frame_scan
        elif isinstance(found, Cloud):
            decoded = decode_cloud(found, message.where, wants_times=True)
            points, T_frame_points = decoded.points, found.T_frame_cloud
            times = None if decoded.times is None else times_after(decoded.times, settled.stamp_ns)
        else:
            raise DamagedMessageError(f"{message.where}: is of type {message.type_name}, not a point cloud")
        if T_frame_points is not None:
            points = points @ T_frame_points[:3, :3].T + T_frame_points[:3, 3]
        return TimedCloud(self._robot.robot_id, stamp_ns, points, None, T_team_sensor, None, boxes, times=times)


class ColoredDepthMaker(DepthFrameMaker):
    """Decoder of depth images, each paired with the colour image of the same size nearest to it."""

    def __init__(
        self, robot: RobotConfig, labels: LabelLookup | None, calibration: RawMessage | None, color_topic: str | None
    ) -> None:
        super().__init__(robot, labels, calibration)
        self._color_topic = color_topic

    @property
    def partner_topics(self) -> tuple[str, ...]:
        """Topic of the colour images, if there is one."""
        return () if self._color_topic is None else (self._color_topic,)

    def make(
        self, settled: Settled[RawMessage], stamp_ns: int, T_team_sensor: Float64Array, boxes: tuple[BodyBox, ...]
    ) -> ColoredDepth:
        """Return a depth image with its colours."""
        frame = super().make(settled._replace(partners=()), stamp_ns, T_team_sensor, boxes)
        if frame.camera.slopes is not None:
            raise InputError(
                f"{settled.message.where}: the image has lens distortion, which odometry does not model; "
                f"name a rectified depth_topic, or set rectified: true if its CameraInfo's P holds"
            )
        colors = None
        for message in settled.partners:
            colors = None if message is None else _colors(message, frame.depth_image.shape, settled.message.topic)
        return ColoredDepth(**vars(frame), colors=colors)


def colored_depth_maker(color_topic: str | None) -> Callable[..., ColoredDepthMaker]:
    """Return the constructor of a decoder of depth images with the colours of a topic."""
    return functools.partial(ColoredDepthMaker, color_topic=color_topic)


def times_after(times: npt.NDArray[Any], stamp_ns: int) -> Float64Array | None:
    """Return the times of points after a stamp, (P,) [s], from a field of any unit and origin; None if it has no times.

    Integers and floats are seconds, milli-, micro- or nanoseconds: the unit in which the sweep takes 2 ms to 2 s. They
    count from the stamp, or are times of day or dates; the latter count from the stamp where it is within 2 s of them,
    else from the first point.
    """
    if times.size == 0 or (times.dtype.kind == "f" and not np.isfinite(times).all()):
        return None
    first = times.min()
    # Dates in nanoseconds need all digits of the difference.
    with np.errstate(over="ignore"):
        span = float(times.max() - first) if times.dtype.kind == "f" else float(int(times.max()) - int(first))
    unit = next((unit for unit in _UNITS if _SHORTEST_SWEEP <= span * unit <= _LONGEST_SWEEP), None)
    if unit is None:
        return None
    since_first: Float64Array = (times - first).astype(np.float64) * unit
    start = float(first) * unit
    offset = start - stamp_ns / 1e9
    if abs(start) <= _LONGEST_SWEEP:
        return since_first + start
    return since_first + (offset if abs(offset) <= _LONGEST_SWEEP else 0.0)


def _colors(message: RawMessage, shape: tuple[int, ...], depth_topic: str) -> UInt8Array:
    """Colours (H, W, 3) of a colour or grey image."""
    found = message.sensor_message()
    if not isinstance(found, Image | CompressedImage):
        raise DamagedMessageError(f"{message.where}: is of type {message.type_name}, not an image")
    pixels = decode_labels(found, message.where).pixels
    if pixels.dtype != np.uint8 or pixels.shape[:2] != shape:
        raise InputError(
            f"{message.where}: the image is {pixels.shape[1]}x{pixels.shape[0]} of {pixels.dtype}, but the depth image "
            f"of '{depth_topic}' is {shape[1]}x{shape[0]}; name another --color-topic, or use --sensor depth"
        )
    return np.ascontiguousarray(pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2))
