"""KITTI odometry and SemanticKITTI: sequences of Velodyne scans of one car."""

from __future__ import annotations

from pathlib import Path
from types import MappingProxyType
from typing import Any

from octoreplay.errors import InputError
from octoreplay.io.datasets.catalogue.folders import Folders
from octoreplay.io.datasets.cloud_folder import CloudImportSummary, import_clouds


def _write_log(sequence: Path, log: Path, **options: Any) -> CloudImportSummary:
    """Write the log of a sequence, with poses of the lidar."""
    for name, remedy in (
        ("poses.txt", "SemanticKITTI has it there; for KITTI odometry copy poses/NN.txt to this place"),
        ("calib.txt", "it has the row Tr that turns the camera's poses into the lidar's"),
    ):
        if not (sequence / name).is_file():
            raise InputError(f"{sequence / name}: not found; {remedy}")
    rate = None if (sequence / "times.txt").is_file() else 10.0
    return import_clouds(sequence, log, rate=rate, pose_format="kitti", **options)


DATA_SET = Folders(
    name="kitti",
    title="KITTI odometry, SemanticKITTI",
    holds="sequences/NN with velodyne/*.bin, poses.txt, calib.txt, times.txt and, in SemanticKITTI, labels/*.label",
    checked=("the authors' tools (files, poses, Tr); an excerpt of a scan with labels"),
    sources=(
        "https://github.com/PRBonn/semantic-kitti-api/blob/master/generate_sequential.py",
        "https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
    ),
    notes=(
        "Each sequence has a frame of its own. Without times.txt the scans are 0.1 s apart.",
        "To make a team of one sequence, import parts of it with import-clouds.",
    ),
    marker="velodyne/*.bin",
    write_log=_write_log,
    classes=lambda sequence: "semantickitti" if (sequence / "labels").is_dir() else None,
    parameters=MappingProxyType({"max_range": 40.0}),
)
