"""M3ED: cars, quadrupeds and drones with event cameras and a lidar (Chaney and others 2023)."""

from __future__ import annotations

from pathlib import Path
from types import MappingProxyType
from typing import Any

from octoreplay.errors import InputError
from octoreplay.io.datasets.catalogue.folders import Folders
from octoreplay.io.datasets.m3ed_files import DEPTH_SUFFIX, calibration_file
from octoreplay.io.datasets.rgbd_folder import ImportSummary, import_rgbd


def _write_log(sequence: Path, log: Path, **options: Any) -> ImportSummary:
    """Write the log of a sequence."""
    calibration = calibration_file(next(iter(sorted(sequence.glob(f"*{DEPTH_SUFFIX}")))))
    if not calibration.is_file():
        raise InputError(
            f"{calibration}: not found; it has the calibration of the depth images, so download it with them"
        )
    return import_rgbd(sequence, log, **options)


DATA_SET = Folders(
    name="m3ed",
    title="M3ED",
    holds="SEQUENCE with SEQUENCE_depth_gt.h5 and SEQUENCE_data.h5, as the authors' download script stores them",
    checked=(
        "the authors' tools that write the files (names, shapes, units, Cn_T_C0 from the first camera to the n-th, "
        "projection); documentation (calibration); answers of the authors (times of depth and colour images)"
    ),
    sources=(
        "https://m3ed.io/data_overview/datafiles",
        "https://github.com/daniilidis-group/m3ed/blob/main/build_system/lidar_depth/fasterlio_gt.py",
        "https://github.com/daniilidis-group/m3ed/blob/main/build_system/bag_processing/rosbag2hdf5.py",
        "https://github.com/daniilidis-group/m3ed/issues/1",
    ),
    notes=(
        "HDF5 needs pip install 'octoreplay[h5]'.",
        "The depth images of the left event camera are used, with its lens distortion.",
        "From data.h5 only the calibration is read. Sequences for tests are published without depth.",
        "Each sequence has the frame of its first camera, with z up in that camera.",
        "The semantics are not used: their times are those of the colour images, not of the depth images.",
        "They are also warped to the event camera by rotation alone, without the distance between the cameras.",
    ),
    marker=f"*{DEPTH_SUFFIX}",
    write_log=_write_log,
    parameters=MappingProxyType({"max_range": 40.0}),
)
