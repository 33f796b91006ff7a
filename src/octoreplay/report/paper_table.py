"""Numbers of the paper's experiment as a table for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.table import Table

from octoreplay.report import tables


def paper_table(moments: Sequence[Mapping[str, Any]]) -> Table:
    """Table of the paper's experiment: one column per moment, given by the fields of ``study.paper.Moment``."""
    table = tables.styled_table("The paper's experiment")
    table.add_column("")
    for moment in moments:
        table.add_column(f"{moment['seconds']:.0f} s", justify="right")
    rows: tuple[tuple[str, str, Callable[[float], str]], ...] = (
        ("total distance Φ", "total_distance", tables.number),
        ("Φ per pair / squared norm of a map", "relative_distance", tables.share),
        ("known cells", "num_known_cells", "{:,}".format),
        ("cells with different labels", "label_disagreement", tables.share),
        ("agreement, worst robot, all cells", "agreement", tables.share),
        ("agreement, worst robot, occupied cells", "agreement_occupied", tables.share),
        ("map as uniform grid", "grid_bytes", tables.size),
        ("map as octree", "octree_bytes", tables.size),
        ("uniform grid / octree", "ratio", "{:.2f}".format),
    )
    for heading, name, text in rows:
        table.add_row(heading, *(text(moment[name]) for moment in moments))
    return table
