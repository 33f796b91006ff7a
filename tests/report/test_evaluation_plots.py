"""Figures of evaluations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from octoreplay.errors import OutputError
from octoreplay.report import evaluation_plots
from octoreplay.report.evaluation_plots import write_evaluation_figures
from support.evaluation_factory import evaluation
from support.long_suite import long, one_in

NAMES = ["agreement.png", "iou.png", "class_iou.png", "coverage.png", "calibration.png"]


@long
def test_figures_are_not_blank_and_reproducible(tmp_path: Path) -> None:
    paths = write_evaluation_figures(evaluation(), tmp_path / "a")
    assert [path.name for path in paths] == NAMES
    again = write_evaluation_figures(evaluation(), tmp_path / "b")
    for path, other in zip(paths, again, strict=True):
        assert path.read_bytes() == other.read_bytes()
        assert np.asarray(Image.open(path).convert("L")).std() > 5


@long
@pytest.mark.parametrize(("has_central", "num_ticks"), one_in(3, [True, False], [1, 2]))
def test_figures_of_one_tick_or_without_a_centralised_map(tmp_path: Path, num_ticks: int, has_central: bool) -> None:
    judged = evaluation(num_ticks, has_central=has_central)
    assert len(write_evaluation_figures(judged, tmp_path)) == len(NAMES)


@long
def test_without_truth_only_agreement_is_drawn(tmp_path: Path) -> None:
    paths = write_evaluation_figures(evaluation(has_truth=False), tmp_path)
    assert [path.name for path in paths] == ["agreement.png"]


def test_curves_have_the_values_of_the_records() -> None:
    judged = evaluation(6)
    figure = evaluation_plots._curves("title", "label", judged.ticks, "coverage")
    mean, central = figure.axes[0].lines
    np.testing.assert_allclose(mean.get_ydata(), [tick.mean("coverage") for tick in judged.ticks])
    np.testing.assert_allclose(central.get_ydata(), [t.central.score("coverage") for t in judged.ticks])
    np.testing.assert_allclose(mean.get_xdata(), [tick.seconds for tick in judged.ticks])


def test_a_folder_that_cannot_be_made_raises(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_evaluation_figures(evaluation(), tmp_path / "file")
