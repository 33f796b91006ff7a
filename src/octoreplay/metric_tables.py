"""Tables of a run: metrics of ticks, robots, links and pairs of robots, and the robots' poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from octoreplay.data_table import Table
from octoreplay.records import Float64Array
from octoreplay.run_metrics import PAIR_SHARES, LinkMetrics, PairMetrics, RobotMetrics, TickMetrics

METRIC_TABLES: Mapping[str, type] = {
    "ticks": TickMetrics, "robots": RobotMetrics, "links": LinkMetrics, "pairs": PairMetrics,
}  # fmt: skip
"""Tables of metrics, and the records in their rows."""
POSES = "poses"
"""Table of the robots' poses."""


def metrics_table(metrics: Sequence[TickMetrics], kind: str, start_ns: int) -> Table:
    """Return one of the METRIC_TABLES; ``seconds`` counts from ``start_ns``.

    'ticks' has a row per tick, the others a row per tick and record. The columns have the names of the records' fields;
    those of 'ticks' end with the team's numbers of pairs and frames.
    """
    if kind == "ticks":
        table = Table.from_records(TickMetrics, metrics, _times(metrics, start_ns))
        shares = {name: np.array([getattr(tick, name) for tick in metrics], dtype=np.float64) for name in PAIR_SHARES}
        components = np.array([tick.num_components for tick in metrics], dtype=np.int64)
        return Table({**table.columns, **shares, "num_components": components})
    rows = [(tick, record) for tick in metrics for record in getattr(tick, kind)]
    first = _times([tick for tick, _ in rows], start_ns)
    return Table.from_records(METRIC_TABLES[kind], [record for _, record in rows], first)


def pose_table(
    poses: Mapping[str, tuple[Sequence[int], Float64Array]], metrics: Sequence[TickMetrics], start_ns: int
) -> Table:
    """Return the poses by robot_id, stamps [ns] and (P, 7) x, y, z, qx, qy, qz, qw, as rows in the order of time."""
    ticks = {tick.stamp_ns: tick for tick in metrics}
    # An interrupted run may end between the metrics and the poses of a tick.
    rows = [
        (ticks[stamp_ns], robot_id, pose)
        for robot_id, (stamps, numbers) in poses.items()
        for stamp_ns, pose in zip(stamps, numbers, strict=True)
        if stamp_ns in ticks
    ]
    rows.sort(key=lambda row: row[0].stamp_ns)
    columns = {
        **_times([tick for tick, *_ in rows], start_ns),
        "robot_id": np.array([robot_id for _, robot_id, _ in rows], dtype=np.str_),
        "frame_id": np.array([tick.frame_of(robot_id) for tick, robot_id, _ in rows], dtype=np.str_),
    }
    numbers = np.array([pose for *_, pose in rows], dtype=np.float64).reshape(-1, 7)
    return Table(columns | dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), numbers.T, strict=True)))


def _times(ticks: Sequence[TickMetrics], start_ns: int) -> dict[str, npt.NDArray[np.generic]]:
    """Columns that all tables begin with, from the tick of each row."""
    stamps = np.array([tick.stamp_ns for tick in ticks], dtype=np.int64)
    numbers = np.array([tick.tick for tick in ticks], dtype=np.int64)
    return {"tick": numbers, "stamp_ns": stamps, "seconds": (stamps - start_ns) / 1e9}
