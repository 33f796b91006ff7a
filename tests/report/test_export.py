from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.records import LeafTable
from octoreplay.report.cell_colors import FREE_COLOR
from octoreplay.report.export import export_map
from octoreplay.result import open_result
from support import leaf_list
from support.octomap_reader import read_octomap
from support.result_factory import leaf_table, state, write_result

LEAVES = leaf_table()
DARK, YELLOW = [68, 1, 84], [253, 231, 37]


def fill(writer: ResultWriter) -> None:
    """Alpha knows all four leaves; beta knows the first, with other log-odds, and one more."""
    other = LeafTable(
        np.array([[0.1, 0.1, 0.1], [3.1, 3.1, 3.1]]),
        np.array([0.2, 0.2]),
        np.array([[2.0, 5.0], [4.0, 0.0]], dtype=np.float32),
    )
    first = LeafTable(LEAVES.centers[:1], LEAVES.sizes[:1], LEAVES.log_odds[:1])
    rest = LeafTable(LEAVES.centers[1:], LEAVES.sizes[1:], LEAVES.log_odds[1:])
    writer.write_state(state("alpha", 0, 1, leaf_list.encode(first), key=True, num_robots=2))
    writer.write_state(state("beta", 0, 1, leaf_list.encode(other), key=True, num_robots=2))
    writer.write_state(state("alpha", 1, 3, leaf_list.encode(rest), num_robots=2))


@pytest.fixture
def result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    leaf_list.install(monkeypatch)
    return write_result(tmp_path, fill)


def exported(result: Path, **options: object) -> tuple[list[list[float]], list[list[int]], PlyData]:
    """Positions and colours of the points, and the file."""
    path = result.with_name("map.ply")
    count = export_map(result, path, **options)[path]
    data = PlyData.read(path)
    vertices = data["vertex"]
    assert count == len(vertices.data)
    positions = np.column_stack([vertices[name] for name in "xyz"]).astype(np.float64).round(5).tolist()
    return positions, np.column_stack([vertices[name] for name in ("red", "green", "blue")]).tolist(), data


def test_labels_have_the_colours_of_the_classes(result: Path) -> None:
    positions, colors, data = exported(result)
    np.testing.assert_allclose(positions, LEAVES.centers[:3], atol=1e-5)
    assert colors == [[10, 20, 30], [1, 2, 250], [10, 20, 30]]
    assert data["vertex"]["label"].tolist() == [1, 2, 1]


def test_free_leaves_are_optional(result: Path) -> None:
    positions, colors, data = exported(result, free=True)
    assert len(positions) == 4
    assert colors[3] == list(FREE_COLOR)
    assert data["vertex"]["label"].tolist() == [1, 2, 1, 0]


def test_the_comments_name_the_options(result: Path) -> None:
    comments = exported(result, robot="beta")[2].comments
    assert "octoreplay map of beta at tick 1, 1 s after the start" in comments
    assert "resolution 0.2 m, log-odds: posterior of 2 robots" in comments
    assert "classes: 0 free, 1 ground, 2 tree" in comments
    assert "log-odds: mean of 2 robots" in exported(result, map_kind="mean")[2].comments[1]
    with pytest.raises(ConfigError, match="map: 'sum' is not one of posterior, mean"):
        exported(result, map_kind="sum")


def test_the_posterior_has_higher_probabilities(result: Path) -> None:
    own = exported(result, map_kind="mean")[2]["vertex"]["probability"]
    whole = exported(result)[2]["vertex"]["probability"]
    odds = np.exp(2 * LEAVES.log_odds[0])
    assert whole[0] == pytest.approx(odds[0] / (1 + odds.sum()), rel=1e-5)
    assert (whole > own).all()


def test_a_map_at_an_earlier_time_can_be_exported(result: Path) -> None:
    assert len(exported(result, at=2.5)[0]) == 1
    with pytest.raises(InputError, match="no map of robot 'alpha' is stored up to"):
        export_map(result, result.with_name("map.ply"), at=0.5)


def test_probability_colours_run_from_uniform_to_certain(result: Path) -> None:
    _, colors, data = exported(result, color="probability")
    order = np.argsort(data["vertex"]["probability"])
    # Green increases over the whole ramp.
    green = [colors[index][1] for index in order]
    assert green == sorted(green)
    assert "dark 0.333, yellow 1" in data.comments[-1]


def test_disagreement_is_the_distance_to_the_other_robots(result: Path) -> None:
    _, colors, data = exported(result, color="disagreement")
    distances = [4.0, np.sqrt(10), np.hypot(0.5, 0.25)]
    assert data.comments[-1] == "color: disagreement (dark 0, yellow 4)"
    assert colors[0] == YELLOW
    assert np.argsort([color[1] for color in colors]).tolist() == np.argsort(distances).tolist()
    assert colors[2] != DARK


def test_a_team_of_equal_maps_has_no_disagreement(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leaf_list.install(monkeypatch)

    def equal(writer: ResultWriter) -> None:
        for robot_id in ("alpha", "beta"):
            writer.write_state(state(robot_id, 0, 1, leaf_list.encode(LEAVES), key=True))

    assert exported(write_result(tmp_path, equal), color="disagreement")[1] == [DARK] * 3


def test_robot_colours_are_mixed_where_both_robots_know_a_leaf(result: Path) -> None:
    positions, colors, data = exported(result, color="robot")
    first, second = np.array(PALETTE[0]), np.array(PALETTE[1])
    found = {tuple(position): color for position, color in zip(positions, colors, strict=True)}
    assert found == {
        (0.1, 0.1, 0.1): ((first + second) / 2 + 0.5).astype(int).tolist(),
        (0.6, 0.2, 0.2): first.tolist(),
        (1.1, 0.1, 0.3): first.tolist(),
        (3.1, 3.1, 3.1): second.tolist(),
    }
    assert "octoreplay map of alpha, beta" in data.comments[0]
    assert len(exported(result, color="robot", robot="beta")[0]) == 2


def test_voxels_are_exported_as_cubes(result: Path) -> None:
    path = result.with_name("cubes.ply")
    assert export_map(result, path, what="voxels") == {path: 3}
    data = PlyData.read(path)
    assert (data["vertex"].count, data["face"].count) == (24, 36)


@pytest.mark.parametrize("options", [{"what": "mesh"}, {"color": "rainbow"}])
def test_unknown_options_are_refused(result: Path, options: dict[str, str]) -> None:
    with pytest.raises(ConfigError, match="is not one of"):
        export_map(result, result.with_name("map.ply"), **options)


# --- other formats ---------------------------------------------------------------------------------------------------


def test_heights_are_coloured_from_the_lowest_to_the_highest(result: Path) -> None:
    positions, colors, data = exported(result, color="height")
    heights = [position[2] for position in positions]
    assert colors[int(np.argmin(heights))] == DARK
    assert colors[int(np.argmax(heights))] == YELLOW
    assert f"color: height (dark {min(heights):g} m, yellow {max(heights):g} m)" in data.comments


def test_archives_hold_the_leaves(result: Path) -> None:
    path = result.with_name("map.npz")
    count = export_map(str(result), str(path), free=True)[path]
    with np.load(path) as archive, open_result(result) as opened:
        leaves = opened.map("alpha").leaves()
        assert count == len(leaves) == len(archive["sizes"])
        np.testing.assert_array_equal(archive["centers"], leaves.centers)
        np.testing.assert_array_equal(archive["log_odds"], leaves.log_odds)
        np.testing.assert_allclose(archive["probabilities"].sum(axis=1), 1.0, atol=1e-6)
        assert archive["class_names"].tolist() == ["free", *opened.class_table.names]


def test_trees_hold_free_and_occupied_leaves(result: Path) -> None:
    path = result.with_name("map.bt")
    count = export_map(result, path)[path]
    _, leaves = read_octomap(path)
    assert count == len(leaves)
    assert {value for (value,) in leaves.values()} == {True, False}


def test_a_map_without_occupied_leaves_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leaf_list.install(monkeypatch)
    free = LeafTable(LEAVES.centers[:1], LEAVES.sizes[:1], np.array([[-1.0, -1.0]], np.float32))

    def fill_free(writer: ResultWriter) -> None:
        writer.write_state(state("alpha", 0, 1, leaf_list.encode(free), key=True))

    path = write_result(tmp_path, fill_free)
    with pytest.raises(InputError, match="the map of alpha holds no occupied leaf; use --free, or a later time"):
        export_map(path, tmp_path / "map.ply")
    assert export_map(path, tmp_path / "map.ply", free=True) == {tmp_path / "map.ply": 1}


@pytest.mark.parametrize(("num_free", "is_warned"), [(1, True), (2, False)])
def test_a_grid_of_mostly_occupied_cells_warns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, num_free: int, is_warned: bool
) -> None:
    leaf_list.install(monkeypatch)
    centers = np.array([[column + 0.1, 0.1, 0.1] for column in range(4)])
    log_odds = np.full((4, 2), 3.0, np.float32)
    log_odds[:num_free] = -3.0
    leaves = LeafTable(centers, np.full(4, 0.2), log_odds)
    result = write_result(
        tmp_path, lambda writer: writer.write_state(state("alpha", 0, 1, leaf_list.encode(leaves), key=True))
    )
    export_map(result, tmp_path / "map.yaml")
    assert ("leave it out with --heights LOW HIGH" in caplog.text) == is_warned
