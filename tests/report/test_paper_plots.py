import io

import numpy as np
from PIL import Image

from octoreplay.report import paper_plots
from octoreplay.report.map_view import BACKGROUND
from support.result_factory import CLASSES, tick_metrics

METRICS = [tick_metrics(tick) for tick in range(1, 9)]


def test_figures_have_the_moments_and_the_ratio_of_the_paper() -> None:
    figures = paper_plots.paper_figures(METRICS, (1.0, 3.0))
    assert set(figures) == {"total_distance.png", "agreement.png", "packet_size.png"}
    for figure in figures.values():
        for axes in figure.axes:
            assert {1.0, 3.0} <= {line.get_xdata()[0] for line in axes.get_lines() if len(set(line.get_xdata())) == 1}
    ratio = figures["packet_size.png"].axes[1]
    assert any(set(line.get_ydata()) == {paper_plots.PAPER_RATIO} for line in ratio.get_lines())


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
