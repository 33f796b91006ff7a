"""Pictures of maps in figures."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from octoreplay.errors import ConfigError, InputError
from octoreplay.mapping import codec
from octoreplay.report.figures import STYLES
from octoreplay.report.map_figure import map_figure
from octoreplay.result import open_result
from support.octree_factory import octree_of
from support.result_factory import state, write_result

LOOK = STYLES["one-column"]._replace(width=1.0)


def result_of(folder: Path, name: str, cells: dict[tuple[int, int, int], list[float]]) -> Path:
    """Result in which both robots have a map of cells of 0.2 m."""
    (folder / name).mkdir()
    data = codec.encode_packet(octree_of(cells, num_classes=2, resolution=0.2))

    def fill(writer) -> None:
        for robot_id in ("alpha", "beta"):
            writer.write_state(state(robot_id, 0, 1, data, key=True))

    return write_result(folder / name, fill)


def shown(axes) -> set[tuple[int, ...]]:
    """Hues in a picture, as signs of the differences of the channels from their mean."""
    (image,) = axes.images
    pixels = np.asarray(image.get_array()).reshape(-1, 3).astype(int)
    pixels = pixels[(pixels < 255).any(axis=1)]
    return {tuple(row) for row in np.sign(pixels - np.rint(pixels.mean(axis=1, keepdims=True)).astype(int)).tolist()}


def test_maps_side_by_side_have_one_scale_and_the_colours_of_their_classes(tmp_path: Path) -> None:
    wall = {(x, 0, z): [2.0, 1.0] for x, z in itertools.product(range(6), range(3))}
    tree = {(x, 0, z): [1.0, 2.0] for x, z in itertools.product(range(3), range(3))}
    paths = [result_of(tmp_path, "a", wall), result_of(tmp_path, "b", tree)]
    with open_result(paths[0]) as first, open_result(paths[1]) as second:
        figure = map_figure({"wall": first, "tree": second}, LOOK)
        widths = []
        for axes in figure.axes:
            filled = (np.asarray(axes.images[0].get_array()) < 255).any(axis=2)
            widths.append(int(filled.any(axis=0).sum()))
        names = {text.get_text() for text in figure.legends[0].get_texts()}
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["wall", "tree"]
    assert names == {"ground", "tree"}
    assert widths[1] == pytest.approx(widths[0] / 2, rel=0.2)
    # Class tree is blue, (1, 2, 250).
    assert all(row[2] == 1 for row in shown(figure.axes[1]))


def test_scales_are_shared(tmp_path: Path) -> None:
    low, high = {(0, 0, z): [2.0, 1.0] for z in range(2)}, {(0, 0, z): [2.0, 1.0] for z in range(6)}
    paths = [result_of(tmp_path, "a", low), result_of(tmp_path, "b", high)]
    with open_result(paths[0]) as first, open_result(paths[1]) as second:
        figure = map_figure({"a": first, "b": second}, LOOK, color="height")
    bar = figure.axes[-1]
    np.testing.assert_allclose(bar.get_xlim(), [0.1, 1.1])
    assert bar.get_xlabel() == "height [m]"


def test_a_map_of_a_depth_has_coarse_cells(tmp_path: Path) -> None:
    path = result_of(tmp_path, "a", {(0, 0, 0): [2.0, 1.0], (1, 1, 1): [1.0, 3.0], (4, 0, 0): [2.0, 1.0]})
    with open_result(path) as result:
        figure = map_figure({"a": result}, LOOK, max_depth=18)
        names = {text.get_text() for text in figure.legends[0].get_texts()}
        heights = map_figure({"a": result}, LOOK, color="height", max_depth=18).axes[-1].get_xlim()
    # The first coarse cell is a tree.
    assert names == {"ground", "tree"}
    np.testing.assert_allclose(heights, [0.2, 0.2], atol=0.05)


def test_maps_that_cannot_be_drawn_are_refused(tmp_path: Path) -> None:
    path = result_of(tmp_path, "a", {(0, 0, 0): [-2.0, -1.0]})
    with open_result(path) as result:
        with pytest.raises(InputError, match="the map of alpha holds no occupied leaf; use a later time"):
            map_figure({"a": result}, LOOK)
        with pytest.raises(ConfigError, match="color: 'red' is not one of label, height"):
            map_figure({"a": result}, LOOK, color="red")
