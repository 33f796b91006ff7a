"""Figures of stored results, for the command line and Python."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from octoreplay.errors import ConfigError
from octoreplay.report.figures import STYLES
from octoreplay.report.log_time import PlottedRun
from octoreplay.report.map_figure import map_figure
from octoreplay.report.run_figures import FIGURES, run_figure
from octoreplay.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WHAT = (*FIGURES, "map")
"""Names of the figures."""


def result_figure(
    what: str, results: Mapping[str, Result], style: str = "screen", *, robot: str | None = None,
    at: float | None = None, color: str | None = None, max_depth: int | None = None,
) -> Figure:  # fmt: skip
    """Return a figure, one of ``WHAT``, of results by label in a style of ``figures.STYLES``.

    ``robot``, ``at``, ``color`` and ``max_depth`` are those of ``map_figure``. Raises ConfigError for an unknown name,
    and InputError for a result without what the figure shows.
    """
    for name, value, choices in (("what", what, WHAT), ("style", style, tuple(STYLES))):
        if value not in choices:
            raise ConfigError(f"{name}: '{value}' is not one of {', '.join(choices)}")
    if what == "map":
        return map_figure(results, STYLES[style], robot=robot, at=at, color=color, max_depth=max_depth)
    runs = [PlottedRun(label, result.metrics, str(result.path)) for label, result in results.items()]
    return run_figure(what, runs, STYLES[style])
