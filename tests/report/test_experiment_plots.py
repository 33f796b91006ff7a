"""Figures of experiments: what they draw, from rows made by hand."""

import itertools

import numpy as np
import pytest

from octoreplay.report.comparisons import Comparison, Measure
from octoreplay.report.experiment_plots import Contrasts, Curves, Dots, Squares

SCORE = Measure("score", "score", 2)
BYTES = Measure("kB", "bytes", None, 1e-3, is_ratio=True)


def rows(num_villages: int = 6) -> list[dict]:
    """Runs of two rules on two graphs with two steps; the score grows with the step and the village."""
    return [
        {"rule": rule, "graph": graph, "step": step, "gain": gain, "village": village,
         "score": float(step) + 0.01 * village, "bytes": 1e3 * (1 + village)}
        for rule, graph, step, gain, village in itertools.product(
            ("bayes", "flood"), ("ring", "line"), ("0.1", "0.5"), ("1", "2"), range(num_villages)
        )
    ]  # fmt: skip


def rule(row: dict) -> str:
    """Name of a run's rule."""
    return row["rule"]


def test_dots_have_a_marker_and_bars_for_every_label_and_section() -> None:
    comparison = Comparison("runs", "rule", rule, (SCORE, BYTES), "bayes", "graph")
    figure = Dots(comparison).draw({"runs": rows()})
    score, num_bytes = figure.axes
    assert [text.get_text() for text in score.get_yticklabels()] == ["bayes", "flood"]
    assert len(score.containers) == 2
    means, _, (bars,) = score.containers[0].lines
    np.testing.assert_allclose(means.get_xdata(orig=False), [0.325, 0.325])
    assert len(bars.get_segments()) == 2
    # Markers of two sections do not cover each other.
    places = [container.lines[0].get_ydata(orig=False)[0] for container in score.containers]
    assert abs(places[0] - places[1]) > 0.2
    assert num_bytes.get_xscale() == "log"
    figure.canvas.draw()


def test_a_label_can_be_left_out_of_dots() -> None:
    comparison = Comparison("runs", "rule", rule, (SCORE,), "bayes", "graph")
    (score,) = Dots(comparison, without=("bayes",)).draw({"runs": rows()}).axes
    assert [text.get_text() for text in score.get_yticklabels()] == ["flood"]


@pytest.mark.parametrize(
    ("highest", "labels"), [(30.0, [5.0, 10.0, 20.0]), (2000.0, [10.0, 100.0, 1000.0]), (4e6, [100.0, 1e4, 1e6])]
)
def test_numbers_of_a_logarithmic_axis_are_far_apart(highest: float, labels: list[float]) -> None:
    found = {"runs": [{"rule": "flood", "village": 0, "bytes": 1e3 * value} for value in (4.0, highest)]}
    (num_bytes,) = Dots(Comparison("runs", "bytes", lambda row: str(row["bytes"]), (BYTES,))).draw(found).axes
    low, high = num_bytes.get_xlim()
    assert [tick for tick in num_bytes.get_xticks() if low < tick < high] == labels


def test_curves_have_bands_and_theory_as_a_curve() -> None:
    def theory(label: str) -> tuple[np.ndarray, np.ndarray]:
        """A line for each label."""
        x = np.linspace(0.0, 1.0, 100)
        return x, x + (label == "flood")

    plain = Curves("runs", "step", "step", (SCORE,), rule, "graph").draw({"runs": rows()})
    assert len(plain.axes) == 2
    assert [axes.get_xlabel() for axes in plain.axes] == ["", "step"]
    for axes in plain.axes:
        assert len(axes.lines) == 2
        assert len(axes.collections) == 2
        np.testing.assert_allclose(axes.lines[0].get_xdata(), [0.1, 0.5])
    with_theory = Curves("runs", "step", "step", (SCORE,), rule, theory=theory).draw({"runs": rows(2)})
    (axes,) = with_theory.axes
    assert [len(line.get_xdata()) for line in axes.lines] == [2, 100, 2, 100]
    # Measurements are markers without lines between them; two villages have no band.
    assert axes.lines[0].get_linestyle() == "None"
    assert not axes.collections
    plain.canvas.draw()
    with_theory.canvas.draw()


def test_contrasts_have_a_curve_for_every_measure_and_a_panel_for_every_group() -> None:
    panels = {"scores": {"one": SCORE, "other": Measure("", "bytes")}, "bytes": {"one": BYTES}}
    figure = Contrasts("runs", "step", "step", panels, "graph", {"bytes": 2.0}).draw({"runs": rows()})
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["ring\nscores", "ring\nbytes", "line\nscores", "line\nbytes"]
    assert [len(axes.lines) for axes in figure.axes] == [2, 2, 2, 2]
    assert [list(axes.lines[-1].get_ydata()) for axes in figure.axes[1::2]] == [[2.0, 2.0]] * 2
    one, other = figure.axes[0].lines
    np.testing.assert_allclose(one.get_ydata(), [0.125, 0.525])
    np.testing.assert_allclose(other.get_ydata(), [3500.0, 3500.0])
    # A label has one colour in all panels.
    assert figure.axes[1].lines[0].get_color() == one.get_color() != other.get_color()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "other"]
    figure.canvas.draw()


@pytest.mark.parametrize(("least", "scale"), [("0", "symlog"), ("0.01", "log")])
def test_a_logarithmic_axis_shows_zero(least: str, scale: str) -> None:
    steps = {("0.1", "1"): least, ("0.1", "2"): "0.05", ("0.5", "1"): "0.5", ("0.5", "2"): "2"}
    found = [{**row, "step": steps[row["step"], row["gain"]]} for row in rows()]
    figure = Contrasts("runs", "step", "step", {"scores": {"one": SCORE}}, is_log=True).draw({"runs": found})
    figure.canvas.draw()
    (axes,) = figure.axes
    assert axes.get_xscale() == scale
    assert [text.get_text() for text in axes.get_xticklabels()] == list(steps.values())
    # The numbers have different places on the axis, that of 0 too.
    places = axes.transData.transform([(float(step), 0.0) for step in steps.values()])[:, 0]
    assert np.diff(places).min() > 0.1 * (places[-1] - places[0])


def test_squares_have_a_colour_bar_and_the_number_of_every_pair() -> None:
    figure = Squares("runs", "gain", "step", (SCORE, BYTES), "rule").draw({"runs": rows()})
    # Two rules with two measures, each with a colour bar.
    assert len(figure.axes) == 8
    panel = figure.axes[0]
    assert [text.get_text() for text in panel.texts] == ["0.13", "0.13", "0.53", "0.53"]
    assert [text.get_text() for text in panel.get_yticklabels()] == ["0.1", "0.5"]
    figure.canvas.draw()
