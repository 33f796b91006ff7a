"""ScanNet: RGB-D sequences of rooms, exported by the authors' SensReader (Dai and others 2017)."""

from __future__ import annotations

import csv
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from octoreplay.config.class_tables.label_rows import LabelRow, table_of_rows
from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.datasets.catalogue.folders import Folders
from octoreplay.io.datasets.depth_files import read_png
from octoreplay.io.datasets.rgbd_folder import ImportSummary, import_rgbd
from octoreplay.records import ClassTable

_RATE = 30.0
_TABLE = "scannetv2-labels.combined.tsv"


def _write_log(scene: Path, log: Path, **options: Any) -> ImportSummary:
    """Write the log of a scene."""
    return import_rgbd(scene, log, rate=_RATE, **options)


def _classes(scene: Path) -> str | ClassTable | None:
    """Classes of a scene's label images: NYU40 in images of 8 bits, as converted by the tools, else ScanNet's ids."""
    folder = next((scene / name for name in ("label", "label-filt") if (scene / name).is_dir()), None)
    image = None if folder is None else next(iter(sorted(folder.glob("*.png"))), None)
    if folder is None or image is None:
        return None
    if read_png(image).dtype == np.uint8:
        return "nyu40"
    path = next((place / _TABLE for place in (scene, *scene.parents) if (place / _TABLE).is_file()), None)
    if path is None:
        raise InputError(
            f"{folder}: its ids are named by '{_TABLE}', which is not in this folder or above; fetch it "
            "with ScanNet's download script"
        )
    return _own_ids(path)


def _own_ids(path: Path) -> ClassTable:
    """Classes of NYU40 for ScanNet's ids."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            table = [(int(r["id"]), r["nyu40class"]) for r in csv.DictReader(file, delimiter="\t") if r["nyu40class"]]
        return table_of_rows(
            [LabelRow(0, "unannotated", None, True), *(LabelRow(k, n, None) for k, n in table)], PALETTE
        )
    except (OSError, UnicodeDecodeError, KeyError, ValueError, ConfigError) as error:
        raise InputError(f"{path}: is not ScanNet's table of labels with the columns id and nyu40class") from error


DATA_SET = Folders(
    name="scannet",
    title="ScanNet",
    holds="SCENE with depth/N.png (mm), pose/N.txt, intrinsic/intrinsic_depth.txt, and label/ or label-filt/",
    checked="the authors' tools (folders of SensReader, ids of the labels)",
    sources=(
        "https://github.com/ScanNet/ScanNet",
        "https://github.com/ScanNet/ScanNet/tree/master/SensReader/python",
        "https://github.com/ScanNet/ScanNet/blob/master/BenchmarkScripts/2d_helpers/convert_scannet_label_image.py",
    ),
    notes=(
        "Export the .sens files with the authors' SensReader first. The images are imported 1/30 s apart.",
        "16-bit label images hold ScanNet's ids and need scannetv2-labels.combined.tsv, 8-bit ones hold NYU40.",
        "They must have the size of the depth images: resize them without interpolation.",
        "Each scan has a frame of its own.",
    ),
    marker="depth/*.png",
    write_log=_write_log,
    classes=_classes,
    parameters=MappingProxyType({"max_range": 6.0}),
)
