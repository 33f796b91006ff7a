"""Common styles of all figures, drawn without a display, and their files."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from octoreplay.errors import escaped
from octoreplay.io.output_file import mark_written, write_whole, writing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#999999"
COLORS = (BLUE, ORANGE, GREEN, "#CC79A7", "#56B4E9", "#E69F00", "#222222", GREY)
"""Colours that colour-blind readers can distinguish (Okabe and Ito)."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)))
"""Line styles that differ where colours do not."""
SUFFIXES = (".pdf", ".png", ".svg")
"""Suffixes of figures' files."""

_WIDTH = 7.0


class FigureStyle(NamedTuple):
    """Size and fonts of a figure.

    Attributes
    ----------
    width : float
        Width in inches.
    row_height : float
        Height of a row of axes in inches.
    font_size : float
        Size of labels in points; the numbers of axes are smaller.
    line_width : float
        Width of curves in points.
    is_print : bool
        True for figures with a caption below: no title, and a font like that of the text.
    columns : int
        Number of columns of a legend.
    """

    width: float
    row_height: float
    font_size: float
    line_width: float
    is_print: bool
    columns: int

    def figure(self, height: float) -> Figure:
        """Return an empty figure of this width, with the height in inches."""
        return new_figure(self.width, height, 300 if self.is_print else 150)

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Fonts and widths of what is drawn in the body."""
        import matplotlib

        settings: Any = dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width"), self.line_width / 2)
        settings |= {"lines.linewidth": self.line_width, "lines.markersize": 3 * self.line_width}
        settings["font.size"] = self.font_size
        if self.is_print:
            settings |= {"font.family": "STIXGeneral", "mathtext.fontset": "stix"}
        with matplotlib.rc_context(settings):
            yield


STYLES = {
    "screen": FigureStyle(_WIDTH, 1.8, 10.0, 1.6, is_print=False, columns=4),
    "one-column": FigureStyle(3.5, 1.1, 8.0, 1.0, is_print=True, columns=2),
    "two-column": FigureStyle(7.16, 1.3, 8.0, 1.1, is_print=True, columns=4),
    "talk": FigureStyle(10.0, 2.2, 17.0, 2.6, is_print=False, columns=3),
}
"""Styles by name: 'screen', one and two columns of a paper of the IEEE (3.5 in and 7.16 in), and slides."""
SCREEN = STYLES["screen"]


def new_figure(width: float = _WIDTH, height: float = 3.6, dpi: int = 150) -> Figure:
    """Return an empty figure of this size in inches, with this number of pixels per inch."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def style(axes: Axes, title: str = "", x_label: str = "", y_label: str = "") -> Axes:
    """Give axes a title, labels and a grid, and return them."""
    from matplotlib import rcParams

    axes.set_title(title, loc="left", fontsize="medium")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    # Ticks are made when the figure is drawn, which may be outside of the style.
    axes.tick_params(labelsize=0.9 * rcParams["font.size"], labelfontfamily=rcParams["font.family"])
    axes.grid(visible=True, color="#e5e5e5", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def over_log_time(title: str, y_labels: Sequence[str], look: FigureStyle = SCREEN) -> tuple[Figure, list[Axes]]:
    """Return a figure and its axes over log time, one below the other; the first is the highest."""
    ratios = [2] + [1] * (len(y_labels) - 1)
    figure = look.figure(look.row_height * (len(y_labels) + 1))
    stack = figure.subplots(len(y_labels), sharex=True, squeeze=False, height_ratios=ratios)[:, 0].tolist()
    for axes, y_label in zip(stack, y_labels, strict=True):
        style(axes, y_label=y_label)
    if not look.is_print:
        stack[0].set_title(title, loc="left", fontsize="medium")
    stack[-1].set_xlabel("log time [s]")
    figure.align_ylabels(stack)
    return figure, stack


def legend_below(figure: Figure, axes: Axes | None = None, columns: int = 4) -> None:
    """Add a legend below the figure with the entries of ``axes``, or of all axes; at most this many columns."""
    from matplotlib import rcParams

    found = [part.get_legend_handles_labels() for part in ([axes] if axes is not None else figure.axes)]
    handles = {label: handle for pair in found for handle, label in zip(*pair, strict=True)}
    if not handles:
        return
    # Letters are half as wide as high; a handle with its spaces takes the room of ten.
    entry = 0.5 * (10 + max(map(len, handles))) * 0.83 * rcParams["font.size"] / 72
    fitting = max(min(int(figure.get_figwidth() / entry), columns), 1)
    num_rows = -(-len(handles) // fitting)
    # A long legend must not take the room of the axes.
    figure.set_figheight(figure.get_figheight() + max(num_rows - 2, 0) * 1.4 * 0.83 * rcParams["font.size"] / 72)
    figure.legend(
        handles.values(), handles.keys(), frameon=False, fontsize="small", loc="outside lower center",
        ncols=-(-len(handles) // num_rows),
    )  # fmt: skip


def mark_isolated(axes: Axes, times: Any, values: Any, *, color: Any, marker: str = "o") -> None:
    """Mark the finite values (n,) between missing ones, of which a line shows nothing."""
    known = np.concatenate([[False], np.isfinite(np.asarray(values, np.float64)), [False]])
    isolated = known[1:-1] & ~known[:-2] & ~known[2:]
    if isolated.any():
        axes.plot(np.asarray(times)[isolated], np.asarray(values)[isolated], marker, color=color, markersize=3.5)


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
    """Put a tick at every decade, or at fewer of many, and at 2 and 5 between where there is room."""
    from matplotlib.axis import XAxis
    from matplotlib.ticker import LogLocator, NullLocator

    low, high = axis.get_view_interval()
    # Numbers beside each other need more room than those above each other.
    widest, most = (100, 5) if isinstance(axis, XAxis) else (1000, 100)
    if high < widest * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=100))
    else:
        axis.set_major_locator(LogLocator(numticks=most))
    axis.set_minor_locator(NullLocator())


def plain(text: str) -> str:
    """Return a name as matplotlib shows it: control characters are escaped, and '$' does not begin a formula.

    ``picture_of`` does this for all texts but the labels of ticks.
    """
    return escaped(text).replace("$", r"\$")


def picture_of(figure: Figure, suffix: str = ".png") -> bytes:
    """Return a figure as PNG, PDF or SVG, by the suffix; equal figures give equal bytes."""
    import matplotlib
    from matplotlib.text import Text

    for part in figure.findobj(Text):
        part.set_text(plain(part.get_text()))
    picture = io.BytesIO()
    # The metadata would name matplotlib's version and the time.
    metadata = {
        ".png": {"Software": None},
        ".pdf": {"Creator": None, "Producer": None, "CreationDate": None},
        ".svg": {"Creator": None, "Date": None},
    }[suffix]
    # Publishers take TrueType fonts only.
    with matplotlib.rc_context({"pdf.fonttype": 42, "svg.hashsalt": "octoreplay"}):
        figure.savefig(picture, format=suffix[1:], metadata=metadata, dpi=300 if suffix != ".png" else "figure")
    return picture.getvalue()


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file; its suffix, one of ``SUFFIXES``, is the format. Raises OutputError."""
    write_whole(path, picture_of(figure, path.suffix.lower()))


def save_figures(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write figures by file name into a folder, made if missing, and return the paths. Raises OutputError."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        write_whole(folder / name, picture_of(figure))
    mark_written(folder)
    return [folder / name for name in figures]
