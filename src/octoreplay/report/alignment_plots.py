"""Figures of an alignment: maps of pairs and of the whole team seen from above, before and after."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.registration.pairs import PairAlignment
from octoreplay.replay.alignment import Alignment
from octoreplay.report.alignment_tables import ranked
from octoreplay.report.figures import BLUE, COLORS, ORANGE, legend_below, new_figure, save_figures, style
from octoreplay.transforms import inverse

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_PAIRS = 30
"""Largest number of pairs that are drawn: the accepted ones first, then the refused ones with the largest L."""

_Layer = tuple[str, Float64Array, str]
"""Name, occupied columns (n, 2) [m] and colour of one robot in a picture."""


def write_alignment_figures(alignment: Alignment, folder: Path) -> list[Path]:
    """Write ``team.png`` and one figure for each of at most ``MAX_PAIRS`` pairs, and return the files.

    Raises OutputError.
    """
    figures = {"team.png": team_figure(alignment)}
    for pair in ranked(alignment.pairs)[:MAX_PAIRS]:
        first, second = alignment.robot_ids[pair.first], alignment.robot_ids[pair.second]
        figures[f"pair_{first}_{second}.png"] = pair_figure(alignment, pair)
    return save_figures(figures, folder)


def team_figure(alignment: Alignment, *, before: str = "before", after: str = "after") -> Figure:
    """Return a figure of the obstacles of all robots seen from above, before and after the alignment.

    ``before`` and ``after`` are the titles of the two pictures.
    """
    ids = alignment.robot_ids
    colors = [COLORS[index % len(COLORS)] for index in range(len(ids))]
    old = [
        (robot_id, _cells(alignment, index, alignment.T_team_own_before[index]), colors[index])
        for index, robot_id in enumerate(ids)
    ]
    new = []
    for frame in alignment.teams[0]:
        index = ids.index(frame.robot_id)
        T = frame.T_team_map @ alignment.T_map_own[index]
        new.append((frame.robot_id, _cells(alignment, index, T), colors[index]))
    left_out = f"; left out: {', '.join(alignment.left_out)}" if alignment.left_out else ""
    return _before_and_after(f"{len(new)} of {len(old)} robots aligned{left_out}", old, new, (before, after))


def pair_figure(alignment: Alignment, pair: PairAlignment) -> Figure:
    """Return a figure of the obstacles of two robots seen from above, before and under the best pose."""
    i, j = pair.first, pair.second
    T_before = inverse(alignment.T_team_own_before[i]) @ alignment.T_team_own_before[j]
    before, after = (
        [
            (alignment.robot_ids[i], _cells(alignment, i, np.eye(4)), BLUE),
            (alignment.robot_ids[j], _cells(alignment, j, T), ORANGE),
        ]
        for T in (T_before, pair.T_first_second)
    )
    agreement = pair.verification
    verdict = "accepted" if pair.is_accepted else f"refused: {pair.refusal}"
    numbers = (
        f"overlap {agreement.overlap:.3f}, q {agreement.obstacles.share_same:.3f}, q_c"
        f" {agreement.obstacles.share_contra:.3f}, q_g {agreement.ground.share_same:.3f}, L {agreement.score:.0f}"
    )
    return _before_and_after(f"{verdict}\n{numbers}", before, after)


def _before_and_after(
    title: str, before: Sequence[_Layer], after: Sequence[_Layer], titles: tuple[str, str] = ("before", "after")
) -> Figure:
    """Figure of two pictures side by side."""
    figure = new_figure(11.0, 6.0)
    left, right = figure.subplots(1, 2)
    _draw(left, titles[0], before)
    _draw(right, titles[1], after)
    figure.suptitle(title, fontsize=11)
    legend_below(figure, left, columns=8)
    return figure


def _cells(alignment: Alignment, index: int, T: Float64Array) -> Float64Array:
    """Occupied columns (n, 2) of a robot's map under a pose (4, 4): centres [m], of obstacles only where z is up."""
    own = alignment.maps[index]
    points = (own.obstacles if alignment.dof == 4 else own.occupied).points
    moved = points @ T[:3, :3].T + T[:3, 3]
    columns: Float64Array = (np.unique(np.floor(moved[:, :2] / own.resolution), axis=0) + 0.5) * own.resolution
    return columns


def _draw(axes: Axes, title: str, layers: Iterable[_Layer]) -> None:
    """Draw the columns of robots."""
    style(axes, title, "x [m]", "y [m]")
    for name, columns, color in layers:
        axes.scatter(columns[:, 0], columns[:, 1], s=3.0, marker="s", linewidths=0, color=color, alpha=0.6)
        # The legend's markers would be as small as the columns.
        axes.scatter([], [], s=30.0, marker="s", linewidths=0, color=color, label=name)
    axes.set_aspect("equal", adjustable="datalim")
