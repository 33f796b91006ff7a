"""Figures of the paper's experiment: disagreement, agreement, packet sizes, and maps beside the true village."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from octoreplay.records import ClassTable, Color, UInt8Array
from octoreplay.report.figures import GREY
from octoreplay.report.log_time import PlottedRun
from octoreplay.report.map_view import BACKGROUND, opacities
from octoreplay.report.run_figures import run_figure
from octoreplay.run_metrics import TickMetrics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER_RATIO = 4.0
"""Ratio of uniform grid to octree in the paper, 'more than four times'."""

_FIGURES = {"total_distance": "phi", "agreement": "agreement", "packet_size": "packets"}
"""Figures over time by the name of their file."""
_INK = "#333333"
_COLOR_STEP = 4
_LEGEND_HEIGHT = 0.9
"""Height of the legend below the pictures in inches."""


def paper_figures(metrics: Sequence[TickMetrics], moments: Sequence[float]) -> dict[str, Figure]:
    """Return the figures over time by file name, with lines at ``moments`` in seconds.

    They are those of ``run_figures``; that of the packets also has the ratio of uniform grid to octree in the paper.
    """
    runs = [PlottedRun("paper", metrics)]
    figures = {f"{name}.png": run_figure(what, runs) for name, what in _FIGURES.items()}
    ratio = figures["packet_size.png"].axes[1]
    ratio.axhline(PAPER_RATIO, color=GREY, linewidth=1.2, linestyle="--")
    ratio.annotate(
        "the paper: more than four", (1.0, PAPER_RATIO), (0, 3), xycoords=("axes fraction", "data"),
        textcoords="offset points", ha="right", fontsize="small", color=_INK,
    )  # fmt: skip
    for figure in figures.values():
        for axes in figure.axes:
            for moment in moments:
                axes.axvline(moment, color=GREY, linewidth=0.8, linestyle=":")
    return figures


def maps_picture(pictures: Mapping[str, UInt8Array], classes: ClassTable, largest: float) -> bytes:
    """Return a PNG of three pictures (height, width, 3) by title: the first large, two beside it, a legend below.

    ``largest`` is the deviation at which the opacity would be 0.
    """
    from PIL import Image

    drawn = np.asarray(_maps_figure(pictures, classes, largest).canvas.buffer_rgba())[..., :3]
    # Colour steps too small to see make the file a third smaller.
    coarse = np.minimum(np.rint(drawn / _COLOR_STEP) * _COLOR_STEP, 255).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(coarse).save(file, "PNG", optimize=True)
    return file.getvalue()


def _maps_figure(pictures: Mapping[str, UInt8Array], classes: ClassTable, largest: float) -> Any:
    """Drawn figure of ``maps_picture``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height, width = next(iter(pictures.values())).shape[:2]
    panel = 8.0 * height / width
    figure: Any = Figure(figsize=(12.0, panel + _LEGEND_HEIGHT), dpi=100)
    FigureCanvasAgg(figure)
    figure.set_facecolor(_unit(BACKGROUND))
    bottom, half = _LEGEND_HEIGHT / (panel + _LEGEND_HEIGHT), panel / 2 / (panel + _LEGEND_HEIGHT)
    places = ((0.0, bottom, 2 / 3, 2 * half), (2 / 3, bottom + half, 1 / 3, half), (2 / 3, bottom, 1 / 3, half))
    for place, (title, picture) in zip(places, pictures.items(), strict=True):
        axes = figure.add_axes(place)
        axes.imshow(picture, interpolation="antialiased")
        axes.set_axis_off()
        axes.text(0.02, 0.97, title, transform=axes.transAxes, va="top", fontsize=14, color=_INK)
    _explain_classes(figure.add_axes((0.02, 0.0, 0.62, bottom)), classes)
    _explain_opacity(figure.add_axes((0.68, 0.36 * bottom, 0.27, 0.24 * bottom)), classes, largest)
    figure.canvas.draw()
    return figure


def _explain_classes(axes: Any, classes: ClassTable) -> None:
    """Draw the legend of the classes."""
    from matplotlib.patches import Patch

    axes.set_axis_off()
    patches = [Patch(facecolor=_unit(entry.color), label=entry.name.replace("_", " ")) for entry in classes.classes]
    axes.legend(
        handles=patches, frameon=False, fontsize=12, labelcolor=_INK, loc="center left", ncols=4, columnspacing=2.0,
        handlelength=1.4,
    )  # fmt: skip


def _explain_opacity(axes: Any, classes: ClassTable, largest: float) -> None:
    """Draw the scale of opacity in the colour of the first class."""
    shares = opacities(np.linspace(0.0, largest, 200), largest)[None, :, None]
    colors = shares * np.array(_unit(classes.classes[0].color)) + (1.0 - shares) * np.array(_unit(BACKGROUND))
    axes.imshow(colors, aspect="auto", extent=(0.0, 1.0, 0.0, 1.0))
    axes.set_xticks([0.0, 1.0], ["0", f"{largest:.2g}"], fontsize=11, color=_INK)
    axes.set_yticks([])
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_title("deviation: largest \u2016h\u1d62 - h\u2c7c\u2016 of two robots", fontsize=11, color=_INK)


def _unit(color: Color) -> tuple[float, float, float]:
    """Colour with channels 0..1, as in matplotlib."""
    red, green, blue = (value / 255.0 for value in color)
    return red, green, blue
