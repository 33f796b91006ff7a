"""Alignments as CSV files, and for JSON (docs/frames.md)."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from octoreplay.io.output_file import write_whole
from octoreplay.records import Float64Array
from octoreplay.registration.pairs import PairAlignment
from octoreplay.replay.alignment import Alignment, RobotFrame
from octoreplay.transforms import inverse, numbers_of

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
PAIR_COLUMNS = (
    "first", "second", "accepted", "refusal", "overlap", "num_cells", "q", "q_c", "q_g", "L", "tilt_degrees",
    *(f"T_first_second.{name}" for name in _POSE),
)  # fmt: skip
"""Columns of the CSV file, one row for each pair."""


def write_alignment(alignment: Alignment, path: Path) -> list[Path]:
    """Write the pairs of an alignment as CSV and return the file. Raises OutputError."""
    write_whole(path, alignment_csv(alignment))
    return [path]


def alignment_csv(alignment: Alignment) -> str:
    """Return all pairs as CSV text with the columns ``PAIR_COLUMNS``."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(PAIR_COLUMNS)
    for pair in alignment.pairs:
        values = _pair(alignment, pair)
        writer.writerow([*(values[name] for name in PAIR_COLUMNS[:-7]), *values["T_first_second"]])
    return text.getvalue()


def alignment_content(alignment: Alignment) -> dict[str, Any]:
    """Return an alignment for JSON: its components with frames and covariances, all pairs, and the sentences."""
    return {
        "components": [[_frame(frame) for frame in team] for team in alignment.teams],
        "left_out": alignment.left_out,
        "pairs": [
            _pair(alignment, pair) | {"information": _position_first(pair.information)} for pair in alignment.pairs
        ],
        "problems": alignment.problems,
        "notes": alignment.notes,
    }


def _frame(frame: RobotFrame) -> dict[str, Any]:
    """The values of one robot's frame."""
    return {
        "robot": frame.robot_id,
        "T_team_map": numbers_of(frame.T_team_map),
        "T_team_map_sigma": frame.sigma,
        "covariance": None if frame.covariance is None else _position_first(frame.covariance),
        "from": frame.origin,
        "evidence": frame.evidence,
        "partner": frame.partner,
    }


def _position_first(matrix: Float64Array) -> list[list[float]]:
    """Matrix (6, 6) over rotation and position with the position first, in the order of ``T_team_map_sigma``."""
    swapped: list[list[float]] = np.roll(matrix, 3, axis=(0, 1)).tolist()
    return swapped


def _pair(alignment: Alignment, pair: PairAlignment) -> dict[str, Any]:
    """The values of one pair, with its pose between the robots' map frames."""
    agreement, own = pair.verification, alignment.T_map_own
    return {
        "first": alignment.robot_ids[pair.first],
        "second": alignment.robot_ids[pair.second],
        "accepted": pair.is_accepted,
        "refusal": pair.refusal,
        "overlap": agreement.overlap,
        "num_cells": agreement.obstacles.total,
        "q": agreement.obstacles.share_same,
        "q_c": agreement.obstacles.share_contra,
        "q_g": agreement.ground.share_same,
        "L": agreement.score,
        "tilt_degrees": math.degrees(pair.tilt),
        "T_first_second": numbers_of(own[pair.first] @ pair.T_first_second @ inverse(own[pair.second])),
    }
