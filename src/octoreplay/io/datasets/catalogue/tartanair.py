"""TartanAir: simulated flights with depth images (Wang and others 2020)."""

from __future__ import annotations

from pathlib import Path
from types import MappingProxyType
from typing import Any

from octoreplay.io.datasets.catalogue.folders import Folders
from octoreplay.io.datasets.rgbd_folder import ImportSummary, import_rgbd

_RATE = 10.0


def _write_log(trajectory: Path, log: Path, **options: Any) -> ImportSummary:
    """Write the log of a trajectory of the left camera."""
    return import_rgbd(trajectory, log, rate=_RATE, **options)


DATA_SET = Folders(
    name="tartanair",
    title="TartanAir",
    holds="ENVIRONMENT/Easy or Hard/PNNN with depth_left/*_left_depth.npy (metres) and pose_left.txt (NED axes)",
    checked="documentation (files, units, axes, intrinsics)",
    sources=(
        "https://github.com/castacks/tartanair_tools",
        "https://github.com/castacks/tartanair_tools/blob/master/data_type.md",
    ),
    notes=(
        "NED axes become x forward, y left, z up.",
        "The trajectories of one environment share its frame, so give the folder of one environment.",
        "The images have no times; they are imported 0.1 s apart.",
        "The segmentation is not used: its numbers are meshes without published names.",
    ),
    marker="depth_left/*_left_depth.npy",
    write_log=_write_log,
    map_frame="map",
    parameters=MappingProxyType({"max_range": 20.0}),
)
