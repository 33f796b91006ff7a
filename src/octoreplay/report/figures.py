"""Common style of all figures, drawn without a display."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octoreplay.errors import OutputError
from octoreplay.io.text_files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#999999"
COLORS = (BLUE, ORANGE, GREEN, "#CC79A7", "#56B4E9", "#E69F00", "#222222", GREY)
"""Colours that colour-blind readers can distinguish (Okabe and Ito)."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def new_figure(width: float = 7.0, height: float = 3.6) -> Figure:
    """Return an empty figure of this size in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def style(axes: Axes, title: str = "", x_label: str = "", y_label: str = "") -> Axes:
    """Give axes a title, labels and a grid, and return them."""
    axes.set_title(title, loc="left", fontsize=11)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(visible=True, color="#e5e5e5", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def over_log_time(title: str, y_labels: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Return a figure and its axes over log time, one below the other; the first is the highest."""
    figure = new_figure(height=1.8 * (len(y_labels) + 1))
    ratios = [2] + [1] * (len(y_labels) - 1)
    stack = figure.subplots(len(y_labels), sharex=True, squeeze=False, height_ratios=ratios)[:, 0].tolist()
    for axes, y_label in zip(stack, y_labels, strict=True):
        style(axes, y_label=y_label)
    stack[0].set_title(title, loc="left", fontsize=11)
    stack[-1].set_xlabel("log time [s]")
    return figure, stack


def legend_below(figure: Figure, axes: Axes | None = None, columns: int = 4) -> None:
    """Add a legend below the figure with the entries of ``axes``, or of all axes."""
    handles: dict[str, Any] = {"handles": axes.get_legend_handles_labels()[0]} if axes is not None else {}
    figure.legend(**handles, frameon=False, fontsize=9, loc="outside lower center", ncols=columns)


def label_in_bytes(axes: Axes) -> None:
    """Label a logarithmic y axis in B, kB, MB: every decade, and 2 and 5 between where there is room."""
    from matplotlib.ticker import EngFormatter

    _decades(axes.yaxis)
    axes.yaxis.set_major_formatter(EngFormatter(unit="B"))


def label_plainly(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers, at the same places as ``label_in_bytes``."""
    _decades(axis)
    axis.set_major_formatter("{x:,g}")


def _decades(axis: Axis) -> None:
    """Put a tick at every decade, and at 2 and 5 between where there is room."""
    from matplotlib.ticker import LogLocator, NullLocator

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1000 * low else (1.0,), numticks=100))
    axis.set_minor_locator(NullLocator())


def save_figures(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write figures by file name into a folder, made if missing, and return the paths. Raises OutputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
    for name, figure in figures.items():
        picture = io.BytesIO()
        # The metadata would name matplotlib's version; without it equal results give equal files.
        figure.savefig(picture, metadata={"Software": None})
        write_whole(folder / name, picture.getvalue())
    return [folder / name for name in figures]
