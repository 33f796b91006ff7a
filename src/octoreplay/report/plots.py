"""Metrics as CSV, and the figures of one run in a folder."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from octoreplay.io.output_file import write_whole
from octoreplay.report.figures import save_figures
from octoreplay.report.log_time import PlottedRun
from octoreplay.report.run_figures import run_figure
from octoreplay.run_metrics import PAIR_SHARES, TickMetrics

_FIGURES = {
    "disagreement.png": "phi", "agreement.png": "agreement", "packet_size.png": "packets",
    "contradiction.png": "contradiction",
}  # fmt: skip
"""Figures of a folder by the name of their file."""
_TEAM_COLUMNS = (
    "tick", "stamp_ns", "settling", "total_distance_published", "total_distance", "total_distance_all",
    "distance_per_leaf",
    "distance_per_cell_and_link", "num_known_cells", "label_disagreement", "max_change",
    *PAIR_SHARES, "num_components",
)  # fmt: skip
_ROBOT_COLUMNS = (
    "active", "num_scans", "num_iterations", "agreement", "agreement_occupied", "num_leaves", "num_cells",
    "observed_volume", "entropy_bits", "memory_bytes", "sent_bytes", "packet_bytes", "octree_bytes", "grid_bytes",
    "unpruned_bytes", "unpruned_compressed_bytes",
)  # fmt: skip
_LINK_COLUMNS = (
    "num_sent", "sent_bytes", "num_delivered", "delivered_bytes", "num_lost", "num_dropped", "num_late", "num_stale",
    "num_gaps", "num_damaged", "bytes_per_second",
)  # fmt: skip
_PAIR_COLUMNS = (
    "overlap_cells", "occupied_cells", "contradiction", "clear_contradiction", "contradiction_of_first",
    "contradiction_of_second",
    "both_occupied_cells", "label_contradiction",
)  # fmt: skip


def metrics_csv(metrics: Sequence[TickMetrics]) -> str:
    """Return all metrics as CSV text, one row per tick: of the team, then of each robot, each link and each pair.

    Columns have the names of the metrics' fields, with the prefix ``<robot>.`` for a robot, ``<sender>><receiver>.``
    for a link and ``<first>&<second>.`` for a pair. Numbers have full precision; values that a tick does not have are
    empty.
    """
    robots = list(dict.fromkeys(robot.robot_id for tick in metrics for robot in tick.robots))
    # Frames are columns only where robots find them during the run.
    framed = robots if any(tick.places for tick in metrics) else []
    links = list(dict.fromkeys((link.sender, link.receiver) for tick in metrics for link in tick.links))
    pairs = list(dict.fromkeys((pair.first, pair.second) for tick in metrics for pair in tick.pairs))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [*_TEAM_COLUMNS, *(f"{robot}.frame" for robot in framed),
         *(f"{robot}.{name}" for robot in robots for name in _ROBOT_COLUMNS),
         *(f"{a}>{b}.{name}" for a, b in links for name in _LINK_COLUMNS),
         *(f"{a}&{b}.{name}" for a, b in pairs for name in _PAIR_COLUMNS)]
    )  # fmt: skip
    for tick in metrics:
        of_robot: dict[Any, Any] = {robot.robot_id: robot for robot in tick.robots}
        of_link: dict[Any, Any] = {(link.sender, link.receiver): link for link in tick.links}
        of_pair: dict[Any, Any] = {(pair.first, pair.second): pair for pair in tick.pairs}
        writer.writerow(
            [*_cells(tick, _TEAM_COLUMNS), *(tick.frame_of(robot) for robot in framed),
             *(v for r in robots for v in _cells(of_robot.get(r), _ROBOT_COLUMNS)),
             *(v for key in links for v in _cells(of_link.get(key), _LINK_COLUMNS)),
             *(v for key in pairs for v in _cells(of_pair.get(key), _PAIR_COLUMNS))]
        )  # fmt: skip
    return text.getvalue()


def write_metrics_csv(metrics: Sequence[TickMetrics], path: Path) -> None:
    """Write ``metrics_csv`` to a file. Raises OutputError."""
    write_whole(path, metrics_csv(metrics))


def write_figures(metrics: Sequence[TickMetrics], folder: Path) -> list[Path]:
    """Write figures of one run: disagreement, agreement, packets and, where robots share known space, contradiction.

    The folder is made if missing. Returns the paths. Raises OutputError, and InputError without any tick.
    """
    run = PlottedRun("the result", metrics)
    has_pairs = any(tick.pairs for tick in metrics)
    chosen = {name: what for name, what in _FIGURES.items() if what != "contradiction" or has_pairs}
    return save_figures({name: run_figure(what, [run]) for name, what in chosen.items()}, folder)


def _cells(record: Any, names: Sequence[str]) -> list[str]:
    """Values of one record as text, empty for None."""
    if record is None:
        return [""] * len(names)
    return [_cell(getattr(record, name)) for name in names]


def _cell(value: Any) -> str:
    """Value as text, empty for NaN; truth values are 0 and 1."""
    if value != value:
        return ""
    return str(int(value)) if isinstance(value, bool | np.bool_) else str(value)
