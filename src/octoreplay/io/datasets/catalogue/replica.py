"""Replica, as rendered for NICE-SLAM and iMAP: depth images of rooms with true poses."""

from __future__ import annotations

from pathlib import Path
from types import MappingProxyType
from typing import Any

from octoreplay.io.datasets.catalogue.folders import Folders
from octoreplay.io.datasets.rgbd_folder import ImportSummary, import_rgbd

_RATE = 30.0


def _write_log(scene: Path, log: Path, **options: Any) -> ImportSummary:
    """Write the log of a scene."""
    return import_rgbd(scene, log, rate=_RATE, **options)


DATA_SET = Folders(
    name="replica",
    title="Replica (rendered for NICE-SLAM)",
    holds="SCENE with results/depthNNNNNN.png (1200x680, 1/6553.5 m) and traj.txt",
    checked="the reader and the configuration of NICE-SLAM (files, unit, intrinsics, camera to world)",
    sources=(
        "https://github.com/cvg/nice-slam/blob/master/src/utils/datasets.py",
        "https://github.com/cvg/nice-slam/blob/master/configs/Replica/replica.yaml",
    ),
    notes=(
        "The images have no times; they are imported 1/30 s apart. Each scene has a frame of its own.",
        "The meshes of the original data set are not read.",
    ),
    marker="results/depth*.png",
    write_log=_write_log,
    parameters=MappingProxyType({"max_range": 10.0}),
)
