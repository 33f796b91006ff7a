"""Figures over log time: their values, settling, zoom, styles, and runs over each other."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from octoreplay.errors import InputError
from octoreplay.report.figures import STYLES, picture_of
from octoreplay.report.log_time import PlottedRun, has_published, over_robots
from octoreplay.report.run_figures import FIGURES, run_figure
from support.long_suite import long, one_in
from support.result_factory import tick_metrics

METRICS = [tick_metrics(tick, settling=tick > 6) for tick in range(1, 9)]
RUN = PlottedRun("first", METRICS)


def changed(**fields: object) -> PlottedRun:
    """Second run, with other values of the team in all ticks."""
    return PlottedRun("second", [dataclasses.replace(tick, **fields) for tick in METRICS])


def with_agreement(label: str, agreement: float) -> PlottedRun:
    """Run in which the agreement of all robots rises from a half to a value."""
    ticks = []
    for number, tick in enumerate(METRICS):
        value = agreement if number else 0.5
        robots = tuple(dataclasses.replace(robot, active=True, agreement=value) for robot in tick.robots)
        ticks.append(dataclasses.replace(tick, robots=robots))
    return PlottedRun(label, ticks)


def curves(axes) -> dict[str, np.ndarray]:
    """Values of the named curves of axes."""
    return {line.get_label(): line.get_ydata() for line in axes.get_lines()}


def over(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation over all robots."""
    values = np.array([[getattr(robot, name) for robot in tick.robots] for tick in METRICS])
    return values.mean(axis=1), values.std(axis=1)


def test_phi_has_the_values_of_the_metrics() -> None:
    [axes] = run_figure("phi", [RUN]).axes
    found = curves(axes)
    np.testing.assert_array_equal(found["\u03a6 over the links"], [tick.total_distance for tick in METRICS])
    np.testing.assert_array_equal(found["\u03a6 over all pairs"], [tick.total_distance_all for tick in METRICS])
    assert axes.get_yscale() == "log"


def test_packets_have_mean_deviation_and_ratio() -> None:
    upper, lower = run_figure("packets", [RUN]).axes
    grid, deviation = over("grid_bytes")
    label = next(name for name in curves(upper) if name.startswith("uniform grid"))
    np.testing.assert_allclose(curves(upper)[label], grid)
    assert upper.collections[0].get_paths()[0].vertices[:, 1].max() == grid[-1] + deviation[-1]
    np.testing.assert_allclose(lower.get_lines()[0].get_ydata(), grid / over("octree_bytes")[0])


def test_agreement_is_the_mean_over_active_robots_and_the_worst() -> None:
    all_cells, occupied, labels = run_figure("agreement", [RUN]).axes
    for axes, name in ((all_cells, "agreement"), (occupied, "agreement_occupied")):
        mean, worst = (line.get_ydata() for line in axes.get_lines())
        values = [[getattr(robot, name) for robot in tick.robots if robot.active] for tick in METRICS]
        np.testing.assert_allclose(mean, [np.mean(row) for row in values])
        np.testing.assert_allclose(worst, [min(row) for row in values])
    np.testing.assert_array_equal(labels.get_lines()[0].get_ydata(), [tick.label_disagreement for tick in METRICS])


def test_coverage_is_the_share_of_the_known_cells() -> None:
    volume, share = run_figure("coverage", [RUN]).axes
    np.testing.assert_allclose(volume.get_lines()[0].get_ydata(), over("observed_volume")[0])
    known = np.array([tick.num_known_cells for tick in METRICS])
    np.testing.assert_allclose(share.get_lines()[0].get_ydata(), over("num_cells")[0] / known)


def test_links_have_a_row_each_and_a_cross_at_losses() -> None:
    rows, team, _ = run_figure("links", [RUN]).axes
    assert [label.get_text() for label in rows.get_yticklabels()] == ["alpha \u2192 beta", "beta \u2192 alpha"]
    delivered = [[link.delivered_bytes for link in tick.links] for tick in METRICS]
    np.testing.assert_array_equal(rows.collections[0].get_array(), np.transpose(delivered))
    np.testing.assert_array_equal(team.get_lines()[0].get_ydata(), np.sum(delivered, axis=1))
    [crosses] = [line for line in rows.get_lines() if line.get_marker() == "x"]
    assert len(crosses.get_xdata()) == 2 * len(METRICS)


def test_contradiction_of_several_runs_is_that_of_the_worst_pair() -> None:
    figure = run_figure("contradiction", [RUN, changed()])
    for axes, name in zip(figure.axes, ("contradiction", "clear_contradiction", "label_contradiction"), strict=True):
        for line in axes.get_lines()[:2]:
            np.testing.assert_allclose(line.get_ydata(), [100 * getattr(tick, name) for tick in METRICS])


def test_the_pairs_with_the_largest_clear_contradiction_are_named() -> None:
    [pair] = METRICS[-1].pairs
    pairs = [
        dataclasses.replace(pair, second=f"robot {n}", contradiction=0.5 - 0.02 * n, clear_contradiction=0.01 * n)
        for n in range(12)
    ]
    robots = tuple(dataclasses.replace(METRICS[0].robots[0], robot_id=name) for name in
                   ("alpha", *(one.second for one in pairs)))  # fmt: skip
    figure = run_figure("contradiction", [changed(pairs=tuple(pairs), robots=robots)])
    names = {line.get_label() for axes in figure.axes for line in axes.get_lines()}
    assert "alpha, robot 11" in names
    assert "alpha, robot 0" not in names


@pytest.mark.parametrize("what", one_in(3, FIGURES))
def test_runs_differ_in_colour_line_and_marker_and_are_named(what: str) -> None:
    runs = [PlottedRun(f"run {n}", METRICS) for n in range(4)]
    figure = run_figure(what, runs)
    [legend] = figure.legends
    names = [text.get_text().partition(" (")[0] for text in legend.get_texts()]
    assert names == ["run 0", "run 1", "run 2", "run 3", "settling, no new scans"]
    lines = figure.axes[0].get_lines()[:4]
    for value in ("get_color", "get_linestyle", "get_marker"):
        assert len({str(getattr(line, value)()) for line in lines}) == 4


def with_robots(run: PlottedRun, tick_numbers: range, **fields: object) -> PlottedRun:
    """Run with other values of all robots in some ticks."""
    ticks = [
        dataclasses.replace(tick, robots=tuple(dataclasses.replace(robot, **fields) for robot in tick.robots))
        if tick.tick in tick_numbers else tick for tick in run.metrics
    ]  # fmt: skip
    return PlottedRun("other", ticks)


def test_values_without_neighbours_are_marked() -> None:
    ticks = [tick if number % 3 == 1 else dataclasses.replace(tick, links=()) for number, tick in enumerate(METRICS)]
    _, team, _ = run_figure("links", [PlottedRun("first", ticks)]).axes
    line, isolated = team.get_lines()[:2]
    assert isolated.get_marker() == "o"
    np.testing.assert_array_equal(isolated.get_ydata(), line.get_ydata()[1::3])


def test_phi_of_equal_maps_is_a_line_at_zero() -> None:
    equal = changed(total_distance=0.0, total_distance_all=0.0, total_distance_published=0.0)
    [axes] = run_figure("phi", [equal]).axes
    np.testing.assert_array_equal(curves(axes)["\u03a6 over the links"], np.zeros(len(METRICS)))
    assert axes.get_ylim()[0] < 0.0


def test_maps_that_are_not_sent_do_not_widen_the_axis_of_packets() -> None:
    silent = with_robots(RUN, range(99), packet_bytes=0)
    alone, beside = (run_figure("packets", [RUN, other]).axes[0].get_ylim() for other in (RUN, silent))
    assert beside == pytest.approx(alone)


def test_the_axis_of_coverage_shows_the_whole_band() -> None:
    one, two = METRICS[0].robots
    robots = (dataclasses.replace(one, num_cells=100), dataclasses.replace(two, num_cells=300))
    share = run_figure("coverage", [changed(robots=robots, num_known_cells=1000)]).axes[1]
    assert share.get_ylim()[0] < 0.1
    assert share.get_ylim()[1] > 0.3


# --- settling and zoom -----------------------------------------------------------------------------------------------


def band(axes) -> tuple[float, float]:
    """Ends of the band of settling."""
    [patch] = axes.patches
    low, high = patch.get_extents().transformed(axes.transData.inverted()).intervalx
    return round(low, 6), round(high, 6)


def test_settling_is_a_band_from_the_end_of_the_logs() -> None:
    for what in ("phi", "packets"):
        for axes in run_figure(what, [RUN, changed()]).axes:
            assert band(axes) == (5.0, 7.0)
    unsettled = PlottedRun("a", [dataclasses.replace(tick, settling=False) for tick in METRICS])
    assert not run_figure("phi", [unsettled]).axes[0].patches


def test_the_fall_of_settling_does_not_compress_the_values_before_it() -> None:
    falling = [
        dataclasses.replace(tick, total_distance=0.0 if tick.tick == 8 else 1e-12) if tick.settling else tick
        for tick in METRICS
    ]
    [axes] = run_figure("phi", [PlottedRun("a", falling)]).axes
    least = min(tick.total_distance_all for tick in METRICS if not tick.settling)
    assert 1e-3 * least < axes.get_ylim()[0] < least
    [label] = [name for name in curves(axes) if name.startswith("\u03a6 over the links (")]
    assert label == "\u03a6 over the links (0 at the end)"
    # Equal maps are a gap, not a point far below.
    assert np.isnan(curves(axes)[label][-1])


def test_a_run_without_disagreement_is_drawn() -> None:
    zero = changed(total_distance=0.0, total_distance_all=0.0, total_distance_published=0.0)
    assert run_figure("phi", [zero]).axes[0].get_yscale() == "linear"


@pytest.mark.parametrize("values", [(0.994, 0.999), pytest.param((0.9994, 0.9999), marks=long)])
def test_agreements_near_one_can_be_told_apart(values: tuple[float, float]) -> None:
    runs = [with_agreement(f"{value}", value) for value in values]
    figure = run_figure("agreement", runs)
    axes = figure.axes[0]
    places = [axes.transData.transform((0.0, value))[1] for value in (0.5, *values)]
    assert places[2] - places[1] > 0.08 * axes.bbox.height
    low, high = axes.get_ylim()
    assert low < 0.5 < values[1] < high
    figure.draw_without_rendering()
    assert "99 %" in [label.get_text() for label in axes.get_yticklabels()]


# --- styles and bad input --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "width"), [("one-column", 3.5), ("two-column", 7.16), ("talk", 10.0)])
def test_styles_have_their_width_and_fonts(name: str, width: float) -> None:
    figure = run_figure("phi", [RUN], STYLES[name])
    [axes] = figure.axes
    assert figure.get_figwidth() == width
    assert axes.yaxis.label.get_fontsize() == STYLES[name].font_size
    assert axes.get_xticklabels()[0].get_fontsize() == 0.9 * STYLES[name].font_size
    assert bool(axes.get_title(loc="left")) == (name == "talk")


@pytest.mark.parametrize("suffix", [".svg", pytest.param(".pdf", marks=long), pytest.param(".png", marks=long)])
def test_equal_figures_give_equal_bytes(suffix: str) -> None:
    first, second = (picture_of(run_figure("phi", [RUN], STYLES["one-column"]), suffix) for _ in range(2))
    assert first == second
    assert first.startswith({".pdf": b"%PDF", ".svg": b"<?xml", ".png": b"\x89PNG"}[suffix])
    # Publishers refuse fonts of type 3.
    assert b"/Type3" not in first


def test_a_robot_that_did_not_publish_is_left_out_of_the_mean() -> None:
    silent = dataclasses.replace(METRICS[0].robots[0], packet_bytes=0, octree_bytes=0, grid_bytes=0)
    tick = dataclasses.replace(METRICS[0], robots=(silent, METRICS[0].robots[1]))
    mean, deviation = over_robots([tick], "grid_bytes", has_published)
    assert mean.tolist() == [METRICS[0].robots[1].grid_bytes]
    assert deviation.tolist() == [0.0]


@pytest.mark.parametrize(
    ("what", "fields", "sentence"),
    [
        ("links", {"links": ()}, "second: the result has no links"),
        ("contradiction", {"pairs": ()}, "second: no two robots"),
    ],
)
def test_results_without_what_a_figure_shows_are_refused(what: str, fields: dict[str, object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        run_figure(what, [RUN, changed(**fields)])


@long
@pytest.mark.parametrize("what", FIGURES)
def test_runs_of_one_tick_are_drawn_and_runs_without_one_are_refused(what: str) -> None:
    assert run_figure(what, [PlottedRun("a", METRICS[3:4])]).axes
    with pytest.raises(InputError, match="a: has no tick to draw"):
        run_figure(what, [PlottedRun("a", [])])
