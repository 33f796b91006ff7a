"""Layouts of folders of depth images: where their images, poses, intrinsics and times are.

Each function below returns the layout of a folder, or None where the folder does not have it. Poses map camera to
world; cameras look along z, with x to the right and y down.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from octoreplay.config.yaml_file import load_json
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.datasets.depth_files import read_depth_npy, read_depth_png, read_ranges, read_rotated_png
from octoreplay.io.datasets.frames_folder import check_folder, last_number, natural_order
from octoreplay.io.datasets.m3ed_files import DEPTH_SUFFIX, calibration_file, read_camera, read_depth_h5, read_track
from octoreplay.io.datasets.pose_files import (
    PoseReader,
    fixed_reader,
    matrix_reader,
    read_tum_track,
    track_reader,
)
from octoreplay.io.robots.robot_log_writer import OPTICAL_IN_BODY
from octoreplay.io.robots.trajectories import read_rows
from octoreplay.io.text_tables import read_matrix, rows, seconds_to_ns
from octoreplay.records import Float64Array

DepthReader: TypeAlias = Callable[[Path], npt.NDArray[Any]]
"""Function that reads a depth image: (H, W) uint16, or float32 in metres."""

_READ_PNG: DepthReader = read_depth_png

MILLIMETRE = 0.001
TUM_UNIT = 1 / 5000
"""Metres per value of the depth images of TUM RGB-D and ICL-NUIM."""

VGA = (640, 480)


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """Frame of a folder: its files, its stamp (None without one) and the reader of its pose."""

    depth_file: Path
    label_file: Path | None
    stamp_ns: int | None
    read_pose: PoseReader


@dataclass(frozen=True, eq=False)
class RgbdLayout:
    """Layout of a folder.

    Attributes
    ----------
    name : str
        Its name.
    frames : list of RgbdFrame
        All frames in their order.
    intrinsics : (fx, fy, cx, cy) or None
        Camera in pixels; None where the folder does not give it.
    size : (W, H) or None
        Image size for which published intrinsics hold, None for the folder's own.
    depth_unit : float
        Metres in one unit of integer depths.
    read_depth : DepthReader
        Reader of its depth images.
    distortion : (k1, k2, p1, p2, k3) or None
        Lens distortion of the depth images in OpenCV's polynomial model, which holds with ``intrinsics``.
    """

    name: str
    frames: list[RgbdFrame]
    intrinsics: tuple[float, float, float, float] | None
    size: tuple[int, int] | None = None
    depth_unit: float = MILLIMETRE
    read_depth: DepthReader = read_depth_png
    distortion: tuple[float, float, float, float, float] | None = None


def find_layout(folder: Path) -> RgbdLayout:
    """Return the layout of a folder, recognised by its files. Raises InputError where there is none."""
    check_folder(folder)
    layout = _layout_of(folder)
    if layout is None and (sequences := find_sequences(folder)):
        raise InputError(
            f"{folder}: holds {len(sequences)} RGB-D sequences such as {sequences[0].name}; name a folder as output for"
            " a log of each"
        )
    if layout is None:
        raise InputError(
            f"{folder}: no RGB-D sequence found; looked for frame-*.depth.png (7-Scenes), depth.txt with"
            " groundtruth.txt (TUM RGB-D), scene_*.depth (ICL-NUIM), results/depth*.png (Replica), depth_left/"
            " (TartanAir), *_depth_gt.h5 (M3ED), and depth/ with pose/, extrinsics/ or a file of poses for all"
            " images: traj*.txt, poses.txt, *.log, *.freiburg"
        )
    return layout


def find_sequences(folder: Path) -> list[Path]:
    """Return the subfolders of a folder that are RGB-D sequences, in their order; none where the folder is one."""
    check_folder(folder)
    if _layout_of(folder) is not None:
        return []
    return [path for path in sorted(folder.iterdir(), key=natural_order) if path.is_dir() and _layout_of(path)]


def with_labels(frames: Sequence[RgbdFrame], folder: Path) -> list[RgbdFrame]:
    """Return the frames with the label images of the same name or number; a frame may have none.

    Raises InputError where no frame has one.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder of label images")
    by_name = {_stem(path): path for path in _images(folder, "*.png")}
    matched = [replace(frame, label_file=by_name.get(_stem(frame.depth_file))) for frame in frames]
    if all(frame.label_file is None for frame in matched):
        raise InputError(
            f"{folder}: no label image has the name of a depth image such as '{frames[0].depth_file.name}'"
        )
    return matched


def _layout_of(folder: Path) -> RgbdLayout | None:
    """The first layout that a folder has."""
    return next((layout for find in _LAYOUTS if (layout := find(folder)) is not None), None)


# --- layouts ----------------------------------------------------------------------------------------------------------


def _seven_scenes(folder: Path) -> RgbdLayout | None:
    """7-Scenes: frame-NNNNNN.depth.png and .pose.txt, with the matrix K here or one folder up."""
    images = _images(folder, "frame-*.depth.png")
    if not images:
        return None
    frames = [_frame(image, matrix_reader(image.with_name(f"{_stem(image)}.pose.txt"))) for image in images]
    for place in (folder, folder.parent):
        if (place / "camera-intrinsics.txt").is_file():
            return RgbdLayout("7-Scenes", frames, _camera_matrix(place / "camera-intrinsics.txt"))
    return RgbdLayout("7-Scenes", frames, (585.0, 585.0, 320.0, 240.0), VGA)


def _tum(folder: Path) -> RgbdLayout | None:
    """TUM RGB-D: depth.txt with stamps and names, and groundtruth.txt, whose poses are interpolated."""
    if not ((folder / "depth.txt").is_file() and (folder / "groundtruth.txt").is_file()):
        return None
    track = read_tum_track(folder / "groundtruth.txt")
    frames = []
    for where, fields in rows(folder / "depth.txt"):
        if len(fields) != 2:
            raise InputError(f"{where}: expects a stamp and a file name, got {len(fields)} words")
        stamp_ns = seconds_to_ns(where, fields[0])
        frames.append(RgbdFrame(folder / fields[1], None, stamp_ns, track_reader(track, stamp_ns)))
    if not frames:
        raise InputError(f"{folder / 'depth.txt'}: lists no depth images")
    frames.sort(key=lambda frame: frame.stamp_ns or 0)
    return RgbdLayout("TUM RGB-D", frames, (525.0, 525.0, 319.5, 239.5), VGA, TUM_UNIT)


def _scannet(folder: Path) -> RgbdLayout | None:
    """ScanNet: depth/N.png, pose/N.txt, intrinsic/intrinsic_depth.txt and, if exported, label/ or label-filt/."""
    images = _images(folder / "depth", "*.png")
    if not images or not (folder / "pose").is_dir():
        return None
    path = folder / "intrinsic" / "intrinsic_depth.txt"
    if not path.is_file():
        raise InputError(f"{path}: not found; a ScanNet folder holds the depth camera's matrix there")
    frames = [_frame(p, matrix_reader(folder / "pose" / f"{p.stem}.txt")) for p in images]
    return RgbdLayout("ScanNet", _labelled(frames, folder, "label", "label-filt"), _camera_matrix(path))


def _sun3d(folder: Path) -> RgbdLayout | None:
    """SUN3D: depth/FRAME-TIME.png and image/FRAME-TIME.jpg, intrinsics.txt, and extrinsics/*.txt.

    TIME is in microseconds. The last file of extrinsics holds three rows of a 3x4 matrix for each colour image, in
    their order; a depth image gets the pose of the colour image that is nearest in time, as in the authors' loader
    (https://sun3d.cs.princeton.edu, loadSUN3D.m).
    """
    images, colours = _images(folder / "depth", "*-*.png"), _images(folder / "image", "*-*.jpg")
    extrinsics = sorted((folder / "extrinsics").glob("*.txt"))
    if not images or not extrinsics:
        return None
    poses = dict(
        zip(
            map(_microseconds, colours),
            _one_each(colours, _matrices(extrinsics[-1]), extrinsics[-1]),
            strict=True,
        )
    )
    times = np.array(list(poses))
    frames = []
    for image in images:
        time = _microseconds(image)
        nearest = int(times[np.abs(times - time).argmin()])
        frames.append(RgbdFrame(image, None, time * 1000, fixed_reader(poses[nearest])))
    return RgbdLayout("SUN3D", frames, _camera_matrix(folder / "intrinsics.txt"), read_depth=read_rotated_png)


def _replica(folder: Path) -> RgbdLayout | None:
    """Replica as rendered for iMAP and NICE-SLAM: results/depthNNNNNN.png, traj.txt, and ../cam_params.json.

    Source: https://github.com/cvg/nice-slam, configs/Replica and src/utils/datasets.py.
    """
    images = _images(folder / "results", "depth*.png")
    if not images or not (folder / "traj.txt").is_file():
        return None
    frames = _with_poses(images, _matrices(folder / "traj.txt"), folder / "traj.txt")
    for place in (folder, folder.parent):
        if (place / "cam_params.json").is_file():
            intrinsics, unit = _replica_camera(place / "cam_params.json")
            return RgbdLayout("Replica", frames, intrinsics, depth_unit=unit)
    return RgbdLayout("Replica", frames, (600.0, 600.0, 599.5, 339.5), (1200, 680), 1 / 6553.5)


def _semantic_replica(folder: Path) -> RgbdLayout | None:
    """Replica as rendered for Semantic-NeRF: depth/depth_N.png in mm, semantic_class/, traj_w_c.txt.

    The horizontal field of view is 90 degrees at 640x480 pixels, with the centre of pixels at whole numbers
    (https://github.com/Harry-Zhi/semantic_nerf).
    """
    images = _images(folder / "depth", "depth_*.png")
    if not images or not (folder / "traj_w_c.txt").is_file():
        return None
    frames = _with_poses(images, _matrices(folder / "traj_w_c.txt"), folder / "traj_w_c.txt")
    frames = _labelled(frames, folder, "semantic_class")
    return RgbdLayout("Replica (Semantic-NeRF)", frames, (320.0, 320.0, 319.5, 239.5), VGA)


def _icl_nuim(folder: Path) -> RgbdLayout | None:
    """ICL-NUIM: depth/N.png in 1/5000 m, or scene_NN_NNNN.depth with ranges, and *.gt.freiburg or *.gt.sim.

    Its camera has fy = -480: y points up, in a left-handed frame
    (https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html). Images and poses are read with y down in camera and world,
    F T F with F = diag(1, -1, 1), which is the same scene in a right-handed frame. Rows of .freiburg begin with the
    number of their image.
    """
    images, read_depth = _images(folder / "depth", "*.png"), _READ_PNG
    ranges = _images(folder, "scene_*.depth")
    path = next((p for place in (folder, folder.parent) for p in sorted(place.glob("*.gt.*"))), None)
    if path is None or path.suffix not in (".freiburg", ".sim") or not (images or ranges):
        return None
    intrinsics = (481.2, 480.0, 319.5, 239.5)
    if not images:
        images, read_depth = ranges, partial(read_ranges, size=VGA, intrinsics=intrinsics)
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    if path.suffix == ".sim":
        numbered = dict(enumerate(_matrices(path)))
    else:
        table = read_rows(path, "tum")
        stamps = () if table.stamps_ns is None else table.stamps_ns.tolist()
        numbered = {round(ns / 1e9): T for ns, T in zip(stamps, table.matrices(), strict=True)}
    frames = []
    for image in images:
        T = numbered.get(last_number(image) or 0)
        frames.append(_frame(image, fixed_reader(None if T is None else flip @ T @ flip)))
    return RgbdLayout("ICL-NUIM", frames, intrinsics, VGA, TUM_UNIT, read_depth)


def _tartanair(folder: Path) -> RgbdLayout | None:
    """TartanAir: depth_left/NNNNNN_left_depth.npy in metres, and pose_left.txt of the left camera in NED axes.

    Source: https://github.com/castacks/tartanair_tools/blob/master/data_type.md (files, axes, intrinsics).
    """
    images, path = _images(folder / "depth_left", "*_left_depth.npy"), folder / "pose_left.txt"
    if not images or not path.is_file():
        return None
    T_body_optical = np.eye(4)
    T_body_optical[:3, :3] = OPTICAL_IN_BODY
    poses = [None if T is None else T @ T_body_optical for T in read_rows(path, "tartanair").matrices()]
    return RgbdLayout(
        "TartanAir", _with_poses(images, poses, path), (320.0, 320.0, 320.0, 240.0), VGA, read_depth=read_depth_npy
    )


def _m3ed(folder: Path) -> RgbdLayout | None:
    """M3ED: SEQUENCE_depth_gt.h5 with images, times and poses, and the camera in SEQUENCE_data.h5."""
    files = sorted(folder.glob(f"*{DEPTH_SUFFIX}"))
    if not files:
        return None
    if len(files) > 1:
        raise InputError(
            f"{folder}: holds {len(files)} files *{DEPTH_SUFFIX}; put each sequence in a folder of its own"
        )
    track = read_track(files[0])
    frames = [
        RgbdFrame(image, None, stamp_ns, fixed_reader(T))
        for image, stamp_ns, T in zip(track.images, track.stamps, track.poses, strict=True)
    ]
    if not calibration_file(files[0]).is_file():
        return RgbdLayout("M3ED", frames, None, read_depth=read_depth_h5)
    camera = read_camera(calibration_file(files[0]))
    return RgbdLayout(
        "M3ED", frames, camera.intrinsics, camera.size, read_depth=read_depth_h5, distortion=camera.distortion
    )


def _numbered(folder: Path) -> RgbdLayout | None:
    """Open3D, Redwood and similar: depth/ with one file of poses for all images, in their order.

    - Depth: PNGs in mm, or NumPy files in metres. Names FRAME-TIME have times in microseconds.
    - Poses: trajectory.log or another .log here or in scene/ (Redwood), else a text file of matrices.
    - Camera: JSON of Open3D, or a matrix; without any, Redwood's of PrimeSense cameras for 640x480 pixels.
    """
    images, read_depth = _images(folder / "depth", "*.png"), _READ_PNG
    if not images:
        images, read_depth = _images(folder / "depth", "*.npy"), read_depth_npy
    tables = [path for pattern in _POSE_TABLES for path in sorted(folder.glob(pattern))]
    if not images or not tables:
        return None
    path, is_log = tables[0], tables[0].suffix == ".log"
    poses = read_rows(path, "redwood" if is_log else None).matrices()
    frames = _labelled(_with_poses(images, poses, path), folder, "semantic", "label", "labels")
    if all(re.fullmatch(r"\d+-\d+", image.stem) for image in images):
        frames = [replace(frame, stamp_ns=_microseconds(frame.depth_file) * 1000) for frame in frames]
    intrinsics, size = _own_camera(folder), None
    if intrinsics is None and is_log:
        intrinsics, size = (525.0, 525.0, 319.5, 239.5), VGA
    return RgbdLayout("Redwood" if is_log else "depth/ with poses", frames, intrinsics, size, read_depth=read_depth)


_LAYOUTS: Sequence[Callable[[Path], RgbdLayout | None]] = (
    _seven_scenes, _tum, _scannet, _sun3d, _replica, _semantic_replica, _icl_nuim, _tartanair, _m3ed,
    _numbered,
)  # fmt: skip
"""Layouts, the most specific first."""

_POSE_TABLES = ("trajectory.log", "*.log", "scene/trajectory.log", "traj*.txt", "poses.txt", "pose.txt")
"""Names of files with the poses of all images, the first choice first."""

_OWN_CAMERAS = ("camera_intrinsic.json", "intrinsic.json", "intrinsics.txt", "camera-intrinsics.txt",
                "intrinsic/intrinsic_depth.txt")  # fmt: skip
"""Names of files with the camera of a folder, the first choice first."""


# --- files ------------------------------------------------------------------------------------------------------------


def _images(folder: Path, pattern: str) -> list[Path]:
    """Files of a folder by a pattern of names, in the order of the numbers in their names."""
    return sorted(folder.glob(pattern), key=natural_order)


def _matrices(path: Path) -> list[Float64Array | None]:
    """Matrices in a file, 3x4 or 4x4."""
    return read_rows(path, "matrices").matrices()


def _frame(image: Path, read_pose: PoseReader) -> RgbdFrame:
    """Frame without a label and a stamp."""
    return RgbdFrame(image, None, None, read_pose)


def _with_poses(images: Sequence[Path], poses: Sequence[Float64Array | None], path: Path) -> list[RgbdFrame]:
    """Frames of images with the poses of a file in the same order."""
    return [_frame(image, fixed_reader(T)) for image, T in zip(images, _one_each(images, poses, path), strict=True)]


def _one_each(
    images: Sequence[Path], poses: Sequence[Float64Array | None], path: Path
) -> Sequence[Float64Array | None]:
    """Poses of a file with one for each image. Raises InputError for another number."""
    if len(poses) != len(images):
        raise InputError(
            f"{path}: has {len(poses)} poses for the {len(images)} images in {images[0].parent}; one is cut"
        )
    return poses


def _labelled(frames: list[RgbdFrame], folder: Path, *names: str) -> list[RgbdFrame]:
    """Frames with the labels in the first of some subfolders that exists, or as they are."""
    found = next((folder / name for name in names if (folder / name).is_dir()), None)
    return frames if found is None else with_labels(frames, found)


def _stem(path: Path) -> str:
    """Part of an image's name that its labels share: frame-000001.depth.png -> frame-000001, depth_7.png -> 7."""
    return re.sub(r"^(depth|semantic_class)_|(\.(depth|label|labels))?\.(png|npy|depth)$", "", path.name)


def _microseconds(path: Path) -> int:
    """Time in the name FRAME-TIME of an image [us]. Raises InputError for another name."""
    found = re.fullmatch(r"\d+-(\d{1,15})", path.stem)
    if found is None:
        raise InputError(f"{path}: expects a name FRAME-TIME with the time in microseconds")
    return int(found[1])


def _camera_matrix(path: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy from a camera matrix."""
    K = read_matrix(path, (3, 4))
    return _checked_camera(path, K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def _checked_camera(path: Path, *numbers: float) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a file. Raises InputError where they are no camera."""
    fx, fy, cx, cy = map(float, numbers)
    if not np.isfinite((fx, fy, cx, cy)).all() or fx <= 0 or fy <= 0:
        raise InputError(f"{path}: is not a camera matrix; its focal lengths must be greater than 0")
    return fx, fy, cx, cy


def _own_camera(folder: Path) -> tuple[float, float, float, float] | None:
    """Camera in a folder: a JSON file of Open3D's PinholeCameraIntrinsic, or a matrix; None without any."""
    path = next((folder / name for name in _OWN_CAMERAS if (folder / name).is_file()), None)
    if path is None or path.suffix != ".json":
        return None if path is None else _camera_matrix(path)
    try:
        # By columns (https://www.open3d.org/docs/release/python_api/open3d.camera.PinholeCameraIntrinsic.html).
        K = [float(number) for number in _read_json(path)["intrinsic_matrix"]]
        return _checked_camera(path, K[0], K[4], K[6], K[7])
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expects the key 'intrinsic_matrix' with 9 numbers") from error


def _replica_camera(path: Path) -> tuple[tuple[float, float, float, float], float]:
    """Camera of a cam_params.json, and metres per depth value."""
    try:
        camera = _read_json(path)["camera"]
        scale = float(camera["scale"])
        if not 0 < scale < np.inf:
            raise ValueError
        return _checked_camera(path, *(float(camera[name]) for name in ("fx", "fy", "cx", "cy"))), 1 / scale
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expects the key 'camera' with the numbers fx, fy, cx, cy and scale") from error


def _read_json(path: Path) -> Mapping[str, Any]:
    """Content of a JSON file. Raises InputError where it is none."""
    try:
        content = load_json(path.read_text(encoding="utf-8"), path.name)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (ConfigError, ValueError) as error:
        raise InputError(f"{path}: is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: expects a JSON object")
    return content
