"""Figures of a sweep's table."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from octoreplay.errors import OutputError
from octoreplay.report import sweep_plots
from octoreplay.report.sweep_plots import write_sweep_figures


def row(seed: int = 0, team: str = "t", status: str = "ok", **values: Any) -> dict[str, Any]:
    return {"team": team, "seed": seed, "status": status, "agreement": math.nan, **values}


ROWS = [
    row(seed, resolution=resolution, rule=rule, agreement=0.1 * seed + float(resolution) + len(rule) / 100)
    for resolution in ("0.2", "0.1", "0.4") for rule in ("bayes", "gradient") for seed in (0, 1)
]  # fmt: skip


def axes_of(rows: list[dict[str, Any]], varied: list[tuple[str, ...]], column: str = "agreement") -> list[Any]:
    figure = sweep_plots._figure(rows, sweep_plots._axes_of(rows, varied), column)
    return [axes for axes in figure.axes if axes.get_visible()]


def test_numeric_settings_become_lines_of_means_with_ranges() -> None:
    (axes,) = axes_of(ROWS, [("resolution",), ("rule",)])
    lines = {entry.get_label(): entry for entry in axes.containers}
    assert list(lines) == ["bayes", "gradient"]
    line, _, (ranges,) = lines["gradient"]
    np.testing.assert_allclose(line.get_xdata(orig=False), [0.1, 0.2, 0.4])
    np.testing.assert_allclose(line.get_ydata(orig=False), [0.23, 0.33, 0.53])
    np.testing.assert_allclose(
        [part[:, 1] for part in ranges.get_segments()], [[0.18, 0.28], [0.28, 0.38], [0.48, 0.58]]
    )
    assert axes.get_xlabel() == "resolution"


def test_other_settings_become_bars() -> None:
    (axes,) = axes_of(ROWS, [("rule",), ("resolution",)])
    assert [text.get_text() for text in axes.get_xticklabels()] == ["bayes", "gradient"]
    assert [bars.get_label() for bars in axes.containers if hasattr(bars, "patches")] == ["0.2", "0.1", "0.4"]
    heights = [[bar.get_height() for bar in bars] for bars in axes.containers if hasattr(bars, "patches")]
    np.testing.assert_allclose(heights, [[0.3, 0.33], [0.2, 0.23], [0.4 + 0.1, 0.4 + 0.13]])


def test_bars_that_would_look_alike_become_points_on_a_zoomed_axis() -> None:
    rows = [row(rule=rule, agreement=value) for rule, value in (("a", 0.994), ("b", 0.999))]
    (axes,) = axes_of(rows, [("rule",)])
    assert not [bars for bars in axes.containers if hasattr(bars, "patches")]
    (line,) = [entry[0] for entry in axes.containers]
    np.testing.assert_allclose(line.get_ydata(orig=False), [0.994, 0.999])
    low, high = axes.get_ylim()
    assert 0.99 < low < 0.994
    assert 0.999 < high < 1.0


def test_shares_near_one_are_stretched() -> None:
    values = (0.5, 0.994, 0.995, 0.999, 0.9995)
    rows = [row(loss=str(n), agreement=value) for n, value in enumerate(values)]
    (axes,) = axes_of(rows, [("loss",)])
    places = [axes.transData.transform((0.0, value))[1] for value in values]
    assert places[3] - places[1] > 0.15 * axes.bbox.height


def test_further_settings_become_panels() -> None:
    rows = [{**entry, "team": team, "loss": "0"} for team in ("a", "b", "c") for entry in ROWS]
    panels = axes_of(rows, [("resolution",), ("rule",), ("loss",)])
    assert [axes.get_title(loc="left") for axes in panels] == [f"loss 0, team {team}" for team in "abc"]


def test_settings_that_are_varied_together_are_one_axis() -> None:
    rows = [row(a=a, b=b, agreement=0.5) for a, b in (("1", "x"), ("2", "y"))]
    (axes,) = axes_of(rows, [("a", "b")])
    assert [text.get_text() for text in axes.get_xticklabels()] == ["1 x", "2 y"]
    assert axes.get_xlabel() == "a+b"


def test_figures_are_drawn_of_columns_with_numbers(tmp_path: Path) -> None:
    rows = [*ROWS, {"team": "t", "seed": 0, "status": "failed", "resolution": "0.2", "rule": "bayes"}]
    varied = [("resolution",), ("rule",)]
    (path,) = write_sweep_figures(rows, varied, tmp_path / "f")
    assert path == tmp_path / "f" / "agreement.png"
    first = path.read_bytes()
    with Image.open(path) as image:
        assert len(np.unique(np.asarray(image.convert("L")))) > 20
    write_sweep_figures(rows, varied, tmp_path / "f")
    assert path.read_bytes() == first
    assert write_sweep_figures([row()], [], tmp_path / "f") == []
    assert not (tmp_path / "f").exists()
    assert write_sweep_figures([], [], tmp_path / "f") == []


@pytest.mark.parametrize(("values", "scale"), [((1.0, 1e6, 0.0), "log"), ((0.0, 0.0, 0.0), "linear")])
def test_values_over_several_decades_have_a_logarithmic_axis(values: tuple[float, ...], scale: str) -> None:
    rows = [row(rule=str(n), total_distance_all=value) for n, value in enumerate(values)]
    (axes,) = axes_of(rows, [("rule",)], "total_distance_all")
    assert axes.get_yscale() == scale
    assert axes.get_ylim()[0] == (pytest.approx(1 / 3) if scale == "log" else 0.0)


def test_a_folder_that_cannot_be_written_raises(tmp_path: Path) -> None:
    (tmp_path / "f").touch()
    with pytest.raises(OutputError, match="f: cannot be written: "):
        write_sweep_figures(ROWS, [("rule",)], tmp_path / "f")
