import io

import numpy as np
from PIL import Image

from octoreplay.report import paper_plots
from octoreplay.report.map_view import BACKGROUND
from support.result_factory import CLASSES, tick_metrics

METRICS = [tick_metrics(tick) for tick in range(1, 9)]


def test_figures_have_the_values_of_the_metrics() -> None:
    [axes] = paper_plots.distance_figure(METRICS, (1.0,)).axes
    np.testing.assert_array_equal(axes.get_lines()[0].get_ydata(), [tick.total_distance for tick in METRICS])
    np.testing.assert_array_equal(axes.get_lines()[0].get_xdata(), range(8))
    assert axes.get_lines()[1].get_xdata() == [1.0, 1.0]

    upper, lower = paper_plots.agreement_figure(METRICS, ()).axes
    worst = [min(robot.agreement for robot in tick.robots if robot.active) for tick in METRICS]
    occupied = [min(robot.agreement_occupied for robot in tick.robots if robot.active) for tick in METRICS]
    assert occupied[0] > occupied[1]  # Beta, which agrees less, is inactive at first.
    np.testing.assert_array_equal(upper.get_lines()[0].get_ydata(), worst)
    np.testing.assert_array_equal(upper.get_lines()[1].get_ydata(), occupied)
    np.testing.assert_array_equal(lower.get_lines()[0].get_ydata(), [tick.label_disagreement for tick in METRICS])


def test_packet_figure_has_mean_deviation_and_ratio() -> None:
    upper, lower = paper_plots.packet_figure(METRICS, ()).axes
    grid = np.array([[robot.grid_bytes for robot in tick.robots] for tick in METRICS])
    octree = np.array([[robot.octree_bytes for robot in tick.robots] for tick in METRICS])
    curves = {line.get_label(): line.get_ydata() for line in upper.get_lines()}
    np.testing.assert_allclose(curves["uniform grid"], grid.mean(axis=1))
    np.testing.assert_allclose(curves["octree"], octree.mean(axis=1))
    band = upper.collections[0].get_paths()[0].vertices
    assert band[:, 1].max() == grid.mean(axis=1)[-1] + grid.std(axis=1)[-1]
    np.testing.assert_allclose(lower.get_lines()[0].get_ydata(), grid.mean(axis=1) / octree.mean(axis=1))
    assert set(lower.get_lines()[1].get_ydata()) == {4.0}


def test_pictures_of_maps_are_placed_side_by_side() -> None:
    colors = {"300 s": (200, 0, 0), "100 s": (0, 200, 0), "The village": (0, 0, 200)}
    pictures = {title: np.full((100, 160, 3), color, np.uint8) for title, color in colors.items()}
    png = paper_plots.maps_picture(pictures, CLASSES, 0.5)
    assert png == paper_plots.maps_picture(pictures, CLASSES, 0.5)
    with Image.open(io.BytesIO(png)) as image:
        shown = np.asarray(image.convert("RGB")).astype(int)
    height, width = shown.shape[:2]
    assert (width, height) == (1200, 590)
    for (x, y), color in zip(((400, 250), (1000, 125), (1000, 375)), colors.values(), strict=True):
        np.testing.assert_allclose(shown[y, x], color, atol=2)
    legend = shown[500:, :600].reshape(-1, 3)
    for entry in CLASSES.classes:
        assert (np.abs(legend - entry.color).max(axis=1) <= 2).sum() > 50
    np.testing.assert_allclose(shown[-2, 2], BACKGROUND, atol=2)
