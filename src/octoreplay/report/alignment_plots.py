"""Figures of an alignment: maps of pairs and of the whole team seen from above, before and after."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from octoreplay.records import TEAM_ORIGIN, Float64Array
from octoreplay.registration.pairs import PairAlignment
from octoreplay.replay.alignment import Alignment
from octoreplay.report.alignment_tables import pair_numbers, ranked
from octoreplay.report.figures import COLORS, legend_below, new_figure, save_figures, style
from octoreplay.transforms import inverse

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_PAIRS = 30
"""Largest number of pairs that are drawn: the accepted ones first, then the refused ones with the largest L."""
# Height and width of the pictures, of those of the maps.
_MARGIN = 1.04

_Layer = tuple[str, Float64Array, str]
"""Name, centres of the occupied columns (n, 2) [m] and colour of one robot in a picture."""


class _View(NamedTuple):
    """Projection of a picture: the plane's axes (2, 3) in the frame that is drawn, and their names."""

    axes: Float64Array
    names: tuple[str, str]


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
    placed = {frame.robot_id: frame.T_team_map for frame in alignment.teams[0]}
    T_new = {ids.index(name): T @ alignment.T_map_own[ids.index(name)] for name, T in placed.items()}
    view = _view(alignment, T_new)
    old = [
        (
            robot_id if robot_id in placed else f"{robot_id} (left out)",
            _columns(alignment, index, alignment.T_team_own_before[index], view),
            _color(index),
        )
        for index, robot_id in enumerate(ids)
    ]
    new = [(ids[index], _columns(alignment, index, T, view), _color(index)) for index, T in T_new.items()]
    first = alignment.teams[0][0]
    frame = f"map frame of {first.robot_id}" if first.origin == TEAM_ORIGIN else "team's frame"
    frames, edge = ("frames as configured", frame), alignment.maps[0].resolution
    return _before_and_after(
        f"{len(new)} of {len(old)} robots aligned", view, (old, new), (before, after), frames, edge
    )


def pair_figure(alignment: Alignment, pair: PairAlignment) -> Figure:
    """Return a figure of the obstacles of two robots seen from above, before and under the best pose."""
    i, j = pair.first, pair.second
    first, second = alignment.robot_ids[i], alignment.robot_ids[j]
    T_map_own = alignment.T_map_own[i]
    T_before = inverse(alignment.T_team_own_before[i]) @ alignment.T_team_own_before[j]
    view = _view(alignment, {i: T_map_own, j: T_map_own @ pair.T_first_second})
    before, after = (
        [
            (first, _columns(alignment, i, T_map_own, view), _color(i)),
            (second, _columns(alignment, j, T_map_own @ T, view), _color(j)),
        ]
        for T in (T_before, pair.T_first_second)
    )
    verdict = "accepted" if pair.is_accepted else f"refused: {pair.refusal}"
    shown = pair_numbers(pair, alignment.dof).items()
    numbers = ", ".join(f"{name} {value}" for name, value in shown if value != "-")
    titles = ("before", "after" if pair.is_accepted else "best pose (refused)")
    frames, edge = (f"map frame of {first}",) * 2, alignment.maps[i].resolution
    return _before_and_after(f"{first} and {second}: {verdict}\n{numbers}", view, (before, after), titles, frames, edge)


def _before_and_after(
    title: str,
    view: _View,
    layers: tuple[Sequence[_Layer], Sequence[_Layer]],
    titles: tuple[str, str],
    frames: tuple[str, ...],
    edge: float,
) -> Figure:
    """Figure of two pictures side by side, in one scale."""
    figure = new_figure(11.0, 6.0)
    panels = figure.subplots(1, 2).tolist()
    bounds = [_bounds([columns for _, columns, _ in drawn]) for drawn in layers]
    half = np.max([(high - low) / 2 for low, high in bounds], axis=0) * _MARGIN + 1.0
    for axes, name, frame, drawn, (low, high) in zip(panels, titles, frames, layers, bounds, strict=True):
        style(axes, name, *(f"{axis} [m], {frame}" for axis in view.names))
        _draw(axes, drawn, edge)
        center = (low + high) / 2
        axes.set_xlim(center[0] - half[0], center[0] + half[0])
        axes.set_ylim(center[1] - half[1], center[1] + half[1])
        axes.set_aspect("equal", adjustable="box")
    figure.suptitle(title, fontsize=11)
    legend_below(figure, panels[0], columns=8)
    return figure


def _color(index: int) -> str:
    """Colour of a robot, the same in all figures."""
    return COLORS[index % len(COLORS)]


def _view(alignment: Alignment, T: Mapping[int, Float64Array]) -> _View:
    """View from above; without a vertical axis that of the largest extent of the maps under poses (4, 4)."""
    if alignment.dof == 4:
        return _View(np.eye(3)[:2], ("x", "y"))
    points = np.concatenate([alignment.maps[i].occupied.points @ P[:3, :3].T + P[:3, 3] for i, P in T.items()])
    if len(points) < 2:
        return _View(np.eye(3)[:2], ("x", "y"))
    # Eigenvalues ascend.
    _, directions = np.linalg.eigh(np.cov(points.T))
    return _View(directions[:, :0:-1].T, ("longest extent", "second extent"))


def _columns(alignment: Alignment, index: int, T: Float64Array, view: _View) -> Float64Array:
    """Centres (n, 2) of the occupied columns of a robot's map under a pose (4, 4) [m], of obstacles where z is up."""
    own = alignment.maps[index]
    points = (own.obstacles if alignment.dof == 4 else own.occupied).points
    moved = (points @ T[:3, :3].T + T[:3, 3]) @ view.axes.T
    columns: Float64Array = (np.unique(np.floor(moved / own.resolution), axis=0) + 0.5) * own.resolution
    return columns


def _bounds(columns: Sequence[Float64Array]) -> tuple[Float64Array, Float64Array]:
    """Smallest and largest coordinates (2,) of all columns; zeros without any."""
    every = np.concatenate([np.empty((0, 2)), *columns])
    return (every.min(axis=0), every.max(axis=0)) if len(every) else (np.zeros(2), np.zeros(2))


def _draw(axes: Axes, layers: Iterable[_Layer], edge: float) -> None:
    """Draw the columns of robots as squares of this edge [m]."""
    from matplotlib.collections import PolyCollection

    corners = edge / 2 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    for name, columns, color in layers:
        squares = columns[:, None] + corners
        # Without antialiasing no lines show between neighbouring squares.
        axes.add_collection(
            PolyCollection(list(squares), facecolors=color, linewidths=0, alpha=0.55, antialiaseds=False), autolim=False
        )
        axes.scatter([], [], s=30.0, marker="s", linewidths=0, color=color, alpha=0.55, label=name)
