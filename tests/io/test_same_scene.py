"""Maps of one scene from many sensors: the encoding of a view does not change the map.

The rays of every camera are cast by formulas of their own (no OpenCV), written as messages, and read back as frames.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from scipy.spatial.transform import Rotation

import octoreplay
from fixtures.writers import write_mcap
from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.records import ClassTable, CloudFrame, DepthFrame, Frame, SemanticClass
from support import room
from support.log_factory import OPTICAL, SECOND, Entry, ros2
from support.long_suite import long
from support.scan_maps import octree_of, packet_of, states_of

CLASSES = ClassTable(
    tuple(SemanticClass(k + 1, name, (0, 0, 0), (raw,)) for k, (raw, name) in enumerate(room.NAMES.items()))
)
START_NS = 1_000 * SECOND
WIDTH, HEIGHT = 160, 120
FOCAL = (118.3, 121.9, 78.2, 62.7)
"""fx, fy, cx, cy of the camera, all different so that an exchange is detected."""

POSES = [
    ((-1.83, -1.22, 0.71), (0.2, 0.03, -0.02)),
    ((-0.51, -0.34, 0.83), (-0.4, 0.11, 0.04)),
    ((0.42, 0.63, 1.14), (-0.9, 0.21, 0.0)),
    ((0.13, 1.81, 0.92), (2.9, 0.17, 0.05)),
]
"""Positions in the room [m] and yaw, pitch, roll [rad] of the body that carries the camera."""


def pose_of(index: int) -> tuple[np.ndarray, np.ndarray]:
    """Position and quaternion of the camera's optical frame."""
    position, angles = POSES[index]
    return np.array(position), (Rotation.from_euler("zyx", angles) * Rotation.from_quat(OPTICAL)).as_quat()


def matrix_of(index: int) -> np.ndarray:
    """T_room_camera (4, 4)."""
    position, quaternion = pose_of(index)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), position
    return T


# --- lenses ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lens:
    """A camera as CameraInfo describes it, and the rays x / z, y / z of its pixels."""

    slopes: Callable[[], np.ndarray]
    model: str = "plumb_bob"
    D: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    K: tuple[float, ...] = FOCAL
    P: tuple[float, ...] = FOCAL
    size: tuple[int, int] = (WIDTH, HEIGHT)
    binning: int = 0
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)


def grid(focal: tuple[float, ...], size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """Pixels (2, H, W) as slopes of a lens that does not distort."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([(u - focal[2]) / focal[0], (v - focal[3]) / focal[1]])


def bent(x: np.ndarray, y: np.ndarray, D: tuple[float, ...]) -> np.ndarray:
    """Distorted slopes of rays by ROS's models plumb_bob and rational_polynomial (REP 104)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*D, 0.0, 0.0, 0.0)[:8]
    r = x * x + y * y
    radial = (1 + r * (k1 + r * (k2 + r * k3))) / (1 + r * (k4 + r * (k5 + r * k6)))
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x), y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y]
    )


@cache
def unbent(D: tuple[float, ...]) -> np.ndarray:
    """Slopes of all pixels of such a lens, by fixed-point iteration on the error."""
    drawn = grid(FOCAL)
    slopes = drawn.copy()
    for _ in range(400):
        slopes += drawn - bent(*slopes, D)
    np.testing.assert_allclose(bent(*slopes, D), drawn, rtol=0, atol=1e-12)
    return slopes


@cache
def fisheye(K: tuple[float, ...], D: tuple[float, ...]) -> np.ndarray:
    """Slopes of a lens of the model equidistant: a ray at the angle t has the radius t + k1 t^3 + k2 t^5 + ..."""
    drawn = grid(K)
    radius = np.hypot(*drawn)
    angle = radius.copy()
    for _ in range(400):
        angle += radius - angle * (1 + sum(k * angle ** (2 * n) for n, k in enumerate(D, start=1)))
    assert angle.max() < np.pi / 2
    return np.tan(angle) / radius * drawn


PLUMB_BOB = (-0.28, 0.07, 0.0012, -0.0008, 0.0)
RATIONAL = (0.31, -0.06, -0.0004, 0.0007, 0.002, 0.58, 0.02, 0.001)
EQUIDISTANT, WIDE = (-0.02, 0.004, -0.003, 0.0006), (71.3, 72.9, 81.4, 57.8)
RECTIFIED = (104.7, 107.2, 83.9, 57.4)

PINHOLE = Lens(lambda: grid(FOCAL))
DISTORTED = {
    "plumb_bob": Lens(lambda: unbent(PLUMB_BOB), D=PLUMB_BOB, P=RECTIFIED),
    "rational_polynomial": Lens(lambda: unbent(RATIONAL), "rational_polynomial", RATIONAL, P=RECTIFIED),
    "equidistant": Lens(lambda: fisheye(WIDE, EQUIDISTANT), "equidistant", EQUIDISTANT, K=WIDE),
}


def view(lens: Lens, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth along z (H, W) float64 in metres, and raw labels (H, W), from one of the poses."""
    x, y = lens.slopes()
    return room.look(matrix_of(index), np.stack([x, y, np.ones_like(x)], axis=-1))


# --- writing and reading ---------------------------------------------------------------------------------------------


def image(stamp_ns: int, pixels: np.ndarray, encoding: str) -> tuple[str, Any]:
    return "sensor_msgs/msg/Image", ros2.image(stamp_ns, pixels, encoding)


def compressed(stamp_ns: int, pixels: np.ndarray, kind: str, head: tuple[float, float]) -> tuple[str, Any]:
    """A PNG with the header of compressed_depth_image_transport."""
    file = io.BytesIO()
    PIL.Image.fromarray(pixels).save(file, "PNG")
    data = np.frombuffer(struct.pack("<iff", 0, *head) + file.getvalue(), np.uint8)
    fields = {"header": ros2.header(stamp_ns, "camera"), "format": f"{kind}; compressedDepth png", "data": data}
    return "sensor_msgs/msg/CompressedImage", ros2.make("sensor_msgs/msg/CompressedImage", **fields)


def millimetres(depth: np.ndarray) -> np.ndarray:
    return np.rint(1000 * depth).astype(np.uint16)


def inverse_depth(stamp_ns: int, depth: np.ndarray) -> tuple[str, Any]:
    """Depth quantised as compressed_depth_image_transport does with its defaults: 10 m, quantisation 100."""
    a = 100.0 * (100.0 + 1.0)
    b = 1.0 - a / 10.0
    return compressed(stamp_ns, np.rint(a / depth + b).astype(np.uint16), "32FC1", (a, b))


WRITERS: Mapping[str, Callable[[int, np.ndarray], tuple[str, Any]]] = {
    "16UC1": lambda t, depth: image(t, millimetres(depth), "16UC1"),
    "32FC1": lambda t, depth: image(t, depth.astype(np.float32), "32FC1"),
    "compressedDepth 16UC1": lambda t, depth: compressed(t, millimetres(depth), "16UC1", (0.0, 0.0)),
    "compressedDepth 32FC1": inverse_depth,
}


def camera_info(lens: Lens, stamp_ns: int) -> Any:
    roi = dict(zip(("x_offset", "y_offset", "width", "height"), lens.roi, strict=True))
    fx, fy, cx, cy = lens.K
    px, py, ux, uy = lens.P
    return ros2.make(
        "sensor_msgs/msg/CameraInfo", header=ros2.header(stamp_ns, "camera"), width=lens.size[0], height=lens.size[1],
        distortion_model=lens.model, d=np.array(lens.D), k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1]),
        r=np.eye(3).ravel(), p=np.array([px, 0, ux, 0, 0, py, uy, 0, 0, 0, 1.0, 0]), binning_x=lens.binning,
        binning_y=lens.binning, roi=ros2.make("sensor_msgs/msg/RegionOfInterest", **roi, do_rectify=False),
    )  # fmt: skip


def pose_entry(index: int) -> Entry:
    position, quaternion = pose_of(index)
    stamp = START_NS + index * SECOND
    value = ros2.odometry(stamp, position, quaternion, frame_id="room", child="camera")
    return Entry("/odom", "nav_msgs/msg/Odometry", value, stamp)


def camera_frames(
    path: Path, lens: Lens, kind: str = "32FC1", *, topic: str = "/camera/depth/image", info: Lens | None = None
) -> list[DepthFrame]:
    """Frames of a log with a lens's views; ``info`` is the lens in its CameraInfo, by default the same."""
    entries = []
    for index in range(len(POSES)):
        stamp = START_NS + index * SECOND
        depth, labels = view(lens, index)
        values = (
            (topic, *WRITERS[kind](stamp, depth)),
            ("/camera/labels/image", *image(stamp, labels, "mono8")),
            ("/camera/depth/camera_info", "sensor_msgs/msg/CameraInfo", camera_info(info or lens, stamp)),
        )
        entries += [pose_entry(index), *(Entry(*value, stamp) for value in values)]
    return frames_in(path, entries)


def cloud_frames(path: Path, lens: Lens) -> list[CloudFrame]:
    """The frames of a log with the same measurements as points."""
    entries = []
    for index in range(len(POSES)):
        stamp = START_NS + index * SECOND
        depth, labels = view(lens, index)
        points = (np.stack([*lens.slopes(), np.ones_like(depth)]) * depth).reshape(3, -1).astype(np.float32)
        cloud = ros2.cloud(stamp, {**dict(zip("xyz", points, strict=True)), "label": labels.ravel()}, frame_id="camera")
        entries += [pose_entry(index), Entry("/points", "sensor_msgs/msg/PointCloud2", cloud, stamp)]
    return frames_in(path, entries)


def frames_in(path: Path, entries: list[Entry]) -> list[Any]:
    """The frames of a log that holds these messages."""
    write_mcap(path, entries)
    config = octoreplay.resolve(RunConfig(octoreplay.discover([path]), classes=CLASSES))
    with RobotLog(config.robots[0], TimeConfig(), config.classes) as log:
        frames = list(log.frames())
    assert len(frames) == len(POSES)
    return frames


def as_clouds(frames: list[DepthFrame]) -> list[CloudFrame]:
    """Depth images as points along the rays of their camera models."""
    clouds = []
    for frame in frames:
        camera = frame.camera
        rays = camera.slopes
        if rays is None:
            rays = grid((camera.fx, camera.fy, camera.cx, camera.cy), (camera.width, camera.height))
        depth = frame.depth_image * frame.depth_unit
        points = np.stack([rays[0] * depth, rays[1] * depth, depth]).reshape(3, -1).T
        class_ids = frame.class_image.ravel()
        clouds.append(CloudFrame(frame.robot_id, frame.stamp_ns, points, class_ids, frame.T_team_sensor))
    return clouds


# --- maps ------------------------------------------------------------------------------------------------------------


def cells_of(frames: list[Frame]) -> tuple[np.ndarray, np.ndarray]:
    """Codes and states of every known cell."""
    return states_of(octree_of(frames, CLASSES.num_classes))


def differing_share(a: list[Frame], b: list[Frame]) -> float:
    """Share of the cells known to either map that the other map lacks or that differ in it."""
    (first, states), (second, other_states) = cells_of(a), cells_of(b)
    shared, i, j = np.intersect1d(first, second, assume_unique=True, return_indices=True)
    return 1 - np.count_nonzero(states[i] == other_states[j]) / (len(first) + len(second) - len(shared))


def occupancy_agreement(a: list[Frame], b: list[Frame]) -> tuple[float, float]:
    """Share of the cells known to both maps with the same state, and the share of ``a``'s cells that both know."""
    (first, states), (second, other_states) = cells_of(a), cells_of(b)
    shared, i, j = np.intersect1d(first, second, assume_unique=True, return_indices=True)
    return np.mean((states[i] > 0) == (other_states[j] > 0)), len(shared) / len(first)


# None of the 72,808 cells differs here; rounding on another machine may change a few.
ROUNDED_RAYS = 5e-5


@pytest.fixture(scope="module")
def metres(tmp_path_factory: pytest.TempPathFactory) -> list[DepthFrame]:
    """The undistorted camera's frames, 32FC1."""
    return camera_frames(tmp_path_factory.mktemp("metres") / "robot.mcap", PINHOLE)


def test_the_scene_has_many_cells(metres: list[DepthFrame]) -> None:
    _, states = cells_of(metres)
    assert len(states) > 70_000
    assert np.count_nonzero(states > 0) > 7_000
    assert set(states[states > 0].tolist()) == {1, 2, 3, 4}


# --- depth as pixels -------------------------------------------------------------------------------------------------


def test_millimetres_give_the_map_of_metres_but_for_rounding(tmp_path: Path, metres: list[DepthFrame]) -> None:
    """Half a millimetre changes 0.0096 % of the cells."""
    frames = camera_frames(tmp_path / "robot.mcap", PINHOLE, "16UC1")
    assert frames[0].depth_image.dtype == np.uint16
    assert 0 < differing_share(frames, metres) < 2e-4


def test_compressed_millimetres_give_the_map_of_plain_ones(tmp_path: Path) -> None:
    plain = camera_frames(tmp_path / "robot.mcap", PINHOLE, "16UC1")
    png = camera_frames(tmp_path / "png.mcap", PINHOLE, "compressedDepth 16UC1", topic="/camera/depth/compressedDepth")
    assert packet_of(png, CLASSES.num_classes) == packet_of(plain, CLASSES.num_classes)


def test_quantised_inverse_depth_gives_the_map_of_metres_but_for_rounding(
    tmp_path: Path, metres: list[DepthFrame]
) -> None:
    """At 6 m a step is 3.6 mm; 0.018 % of the cells differ."""
    frames = camera_frames(tmp_path / "r.mcap", PINHOLE, "compressedDepth 32FC1", topic="/camera/depth/compressedDepth")
    assert frames[0].depth_image.dtype == np.float32
    assert 0 < differing_share(frames, metres) < 4e-4


# --- lenses ----------------------------------------------------------------------------------------------------------


def test_an_image_gives_the_map_of_its_points(tmp_path: Path, metres: list[DepthFrame]) -> None:
    assert differing_share(metres, cloud_frames(tmp_path / "robot.mcap", PINHOLE)) < ROUNDED_RAYS
    assert differing_share(metres, as_clouds(metres)) < ROUNDED_RAYS


@pytest.mark.parametrize("name", DISTORTED)
def test_rays_of_a_lens_are_those_of_its_formula(tmp_path: Path, name: str) -> None:
    """Exact to float32."""
    for frame in camera_frames(tmp_path / "robot.mcap", DISTORTED[name]):
        assert frame.camera.slopes is not None
        np.testing.assert_allclose(frame.camera.slopes, DISTORTED[name].slopes(), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("name", DISTORTED)
def test_rays_of_a_lens_give_the_map_of_its_points(tmp_path: Path, name: str) -> None:
    frames = as_clouds(camera_frames(tmp_path / "robot.mcap", DISTORTED[name]))
    assert differing_share(frames, cloud_frames(tmp_path / "cloud.mcap", DISTORTED[name])) < ROUNDED_RAYS


@long
@pytest.mark.parametrize("name", DISTORTED)
def test_a_distorted_image_gives_the_map_of_its_points(tmp_path: Path, name: str) -> None:
    """With the lens ignored 28 % of the cells differ, and 48 % with the fisheye."""
    frames = camera_frames(tmp_path / "robot.mcap", DISTORTED[name])
    assert differing_share(frames, cloud_frames(tmp_path / "cloud.mcap", DISTORTED[name])) < ROUNDED_RAYS


@pytest.mark.parametrize("name", DISTORTED)
def test_a_distorted_camera_sees_what_an_undistorted_one_sees(
    tmp_path: Path, metres: list[DepthFrame], name: str
) -> None:
    """Other rays graze cells at edges, so 1.2 % differ (fisheye 1.6 %); 11 % and 15 % with the lens ignored."""
    frames = as_clouds(camera_frames(tmp_path / "robot.mcap", DISTORTED[name]))
    agreement, shared = occupancy_agreement(metres, frames)
    assert agreement > 0.98
    assert shared > 0.99


def test_a_rectified_image_uses_P_alone(tmp_path: Path) -> None:
    """K and the distortion are those of the image before rectification."""
    rectified = Lens(lambda: grid(RECTIFIED), K=RECTIFIED, P=RECTIFIED)
    expected = camera_frames(tmp_path / "robot.mcap", rectified)
    raw = DISTORTED["plumb_bob"]
    frames = camera_frames(tmp_path / "rectified.mcap", rectified, topic="/camera/depth/image_rect", info=raw)
    assert packet_of(frames, CLASSES.num_classes) == packet_of(expected, CLASSES.num_classes)


@pytest.mark.parametrize("D", [PINHOLE.D, PLUMB_BOB])
def test_a_binned_region_uses_the_whole_camera(tmp_path: Path, D: tuple[float, ...]) -> None:
    """Every second pixel of columns 20..139 and rows 12..101, as ROS's image_geometry counts them."""
    part = Lens(lambda: unbent(D)[:, 12:102:2, 20:140:2], D=D, binning=2, roi=(20, 12, 120, 90))
    frames = camera_frames(tmp_path / "robot.mcap", part)
    assert frames[0].depth_image.shape == (45, 60)
    assert differing_share(as_clouds(frames), cloud_frames(tmp_path / "cloud.mcap", part)) < ROUNDED_RAYS
