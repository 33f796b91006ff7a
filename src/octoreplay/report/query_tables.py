"""Answers to queries: tables for the terminal, and contents for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from octoreplay.log_odds import best_labels, label_probabilities
from octoreplay.records import LeafTable
from octoreplay.report.tables import number, share, styled_table

if TYPE_CHECKING:
    from octoreplay.stored_map import PointQuery

_Points = Sequence[tuple[float, float, float]]


def point_answers(names: Sequence[str], points: _Points, answer: PointQuery) -> Table:
    """Return a table of the probabilities at points; ``names`` are free, then the classes."""
    table = styled_table("")
    table.add_column("x, y, z [m]", no_wrap=True)
    table.add_column("P(occupied)", justify="right", no_wrap=True)
    table.add_column("P(free)", justify="right", no_wrap=True)
    table.add_column("label")
    table.add_column("next classes")
    table.add_column("leaf", justify="right", no_wrap=True)
    for index, point in enumerate(points):
        if not answer.known[index]:
            table.add_row(_place(point), "", "", "unknown", "", "")
            continue
        row = answer.probabilities[index]
        label, free = int(answer.labels[index]), float(row[0])
        others = [f"{names[k]} {share(row[k])}" for k in _ranked(row) if k != label]
        chosen = f"{names[label]} {share(row[label])}"
        if label == 0 and free < 0.5:
            chosen += ": no class is more probable"
        table.add_row(
            _place(point), share(1.0 - free), share(free), chosen, ", ".join(others[:2]),
            f"{answer.sizes[index]:g} m",
        )  # fmt: skip
    return table


def log_odds_table(names: Sequence[str], points: _Points, answer: PointQuery) -> Table:
    """Return a table of all classes at points, with their probabilities and log-odds; of known points only."""
    table = styled_table("Classes")
    table.add_column("x, y, z [m]", no_wrap=True)
    table.add_column("class", overflow="fold")
    table.add_column("probability", justify="right", no_wrap=True)
    table.add_column("log-odds h", justify="right", no_wrap=True)
    for index, point in enumerate(points):
        if answer.known[index]:
            row = answer.probabilities[index]
            for k in _ranked(row):
                table.add_row(_place(point), names[k], share(row[k]), f"{answer.log_odds[index, k - 1]:.3f}")
    return table


def _place(point: Sequence[float]) -> str:
    """Coordinates of a point."""
    return ", ".join(f"{value:g}" for value in point)


def _ranked(probabilities: Sequence[float]) -> list[int]:
    """Numbers of the classes without free, the most probable first."""
    return sorted(range(1, len(probabilities)), key=lambda k: (-probabilities[k], k))


def box_answer(names: Sequence[str], leaves: LeafTable) -> Table:
    """Return a table of the volume of each class in some leaves; ``names`` are free, then the classes."""
    table = styled_table("")
    table.add_column("label", overflow="fold")
    for heading in ("leaves", "volume", "mean probability"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in _volumes(names, leaves):
        volume = f"{number(row['volume'])} m\u00b3"
        table.add_row(row["label"], f"{row['num_leaves']:,}", volume, share(row["mean_probability"]))
    if not len(leaves):
        table.add_row("unknown", "", "", "")
    return table


def _volumes(names: Sequence[str], leaves: LeafTable) -> list[dict[str, Any]]:
    """Number, volume [m^3] and mean probability of the leaves of each label."""
    labels, volumes = best_labels(leaves.log_odds), leaves.sizes**3
    probabilities = label_probabilities(leaves.log_odds)
    rows = []
    for class_id, name in enumerate(names):
        chosen = labels == class_id
        if chosen.any():
            mean = np.average(probabilities[chosen], weights=volumes[chosen])
            total = float(volumes[chosen].sum())
            rows.append(
                {"label": name, "num_leaves": int(chosen.sum()), "volume": total, "mean_probability": float(mean)}
            )
    return rows


def query_content(
    names: Sequence[str], points: _Points, answer: PointQuery | None, leaves: LeafTable | None
) -> dict[str, Any]:
    """Return the answers for JSON: ``points`` with probabilities and log-odds by class, and ``box`` by label."""
    return {
        "points": [] if answer is None else [_point(names, points[i], answer, i) for i in range(len(points))],
        "box": None if leaves is None else _volumes(names, leaves),
    }


def _point(names: Sequence[str], point: Sequence[float], answer: PointQuery, index: int) -> dict[str, Any]:
    """The answer at one point; only its coordinates in unknown space."""
    if not answer.known[index]:
        return {"point": point, "known": False}
    row = answer.probabilities[index].tolist()
    return {
        "point": point,
        "known": True,
        "p_occupied": 1.0 - row[0],
        "p_free": row[0],
        "label": names[answer.labels[index]],
        "classes": dict(zip(names[1:], row[1:], strict=True)),
        "log_odds": dict(zip(names[1:], answer.log_odds[index].tolist(), strict=True)),
        "leaf_size": float(answer.sizes[index]),
    }
