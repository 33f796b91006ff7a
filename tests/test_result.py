"""Python API of stored results, with lists of leaves in place of the octree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from octoreplay.errors import InputError, PacketError
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.records import LeafTable
from octoreplay.result import Result, open_result
from support import leaf_list
from support.result_factory import CLASSES, SECOND, START, leaf_table, state, summary, team, tick_metrics, write_result

LEAVES = leaf_table()


def part(*rows: int) -> LeafTable:
    return LeafTable(LEAVES.centers[list(rows)], LEAVES.sizes[list(rows)], LEAVES.log_odds[list(rows)])


def fill(writer: ResultWriter) -> None:
    writer.write_state(state("alpha", 0, 1, leaf_list.encode(part(0)), key=True, num_robots=1))
    writer.write_state(state("alpha", 1, 2, leaf_list.encode(part(1)), num_robots=2))
    writer.write_state(state("alpha", 2, 4, leaf_list.encode(part(2, 3)), num_robots=2))
    writer.write_state(state("beta", 0, 4, leaf_list.encode(part(3)), key=True, num_robots=2))


@pytest.fixture
def result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Result:
    leaf_list.install(monkeypatch)
    with open_result(write_result(tmp_path, fill)) as opened:
        yield opened


def test_a_result_has_the_configuration_metrics_and_ticks_of_the_run(result: Result, tmp_path: Path) -> None:
    assert result.robots == ("alpha", "beta")
    assert result.class_table == CLASSES
    assert result.config == team(tmp_path).to_config()
    assert result.metrics == [tick_metrics(tick, settling=tick == 4) for tick in range(1, 5)]
    assert result.summary.stop_reason == summary(result.metrics).stop_reason
    assert result.stored_ticks("alpha") == [1, 2, 4]
    assert result.stored_ticks("beta") == [4]


def test_history_yields_the_maps_of_every_stored_tick(result: Result) -> None:
    seen = []
    for maps in result.history():
        for robot_id, stored in maps.items():
            if stored.tick == max(entry.tick for entry in maps.values()):
                alone = result.map(robot_id, tick=stored.tick).leaves()
                np.testing.assert_array_equal(stored.leaves().log_odds, alone.log_odds)
                np.testing.assert_array_equal(stored.leaves().centers, alone.centers)
                seen.append((robot_id, stored.tick))
    assert seen == [("alpha", 1), ("alpha", 2), ("alpha", 4), ("beta", 4)]


def test_a_missing_centralised_map_is_an_input_error(result: Result) -> None:
    with pytest.raises(InputError, match=r"holds no centralised map.*run the logs again"):
        result.map("central")


def test_times_count_from_tick_zero(result: Result) -> None:
    assert result.start_ns == START
    assert result.seconds(START + 3 * SECOND // 2) == 1.5
    assert result.time_ns(2.25) == START + 9 * SECOND // 4


def test_a_map_is_a_key_frame_and_its_deltas(result: Result) -> None:
    stored = result.map("alpha")
    assert (stored.robot_id, stored.tick, stored.stamp_ns) == ("alpha", 4, START + 4 * SECOND)
    assert (stored.resolution, stored.num_robots, stored.prior) == (0.2, 2, 0.0)
    leaves = stored.leaves(map_kind="mean")
    np.testing.assert_array_equal(leaves.centers, LEAVES.centers)
    np.testing.assert_array_equal(leaves.sizes, LEAVES.sizes)
    np.testing.assert_array_equal(leaves.log_odds, LEAVES.log_odds)


@pytest.mark.parametrize(
    ("selection", "tick"),
    [({"tick": 1}, 1), ({"tick": 2}, 2), ({"tick": 4}, 4), ({"at_ns": START + 3 * SECOND}, 2),
     ({"at_ns": START + 2 * SECOND - 1}, 1), ({"at_ns": START + 99 * SECOND}, 4)],
)  # fmt: skip
def test_maps_are_selected_by_tick_or_time(result: Result, selection: dict[str, int], tick: int) -> None:
    stored = result.map("alpha", **selection)
    assert stored.tick == tick
    assert len(stored.leaves()) == {1: 1, 2: 2, 4: 4}[tick]


def test_maps_that_are_not_stored_are_input_errors(result: Result) -> None:
    with pytest.raises(InputError, match="no map of robot 'alpha' is stored at tick 3; stored nearby: 1, 2, 4"):
        result.map("alpha", tick=3)
    with pytest.raises(InputError, match="no map of robot 'beta' is stored up to the time asked for"):
        result.map("beta", at_ns=START + 3 * SECOND)
    with pytest.raises(InputError, match="robot 'gamma' not found; robots: alpha, beta"):
        result.map("gamma")
    with pytest.raises(ValueError, match="not both"):
        result.map("alpha", at_ns=START, tick=1)


def test_query_at_points(result: Result) -> None:
    points = [[0.15, 0.05, 0.1], [0.79, 0.01, 0.39], [2.1, 0.1, 0.1], [5.0, 5.0, 5.0]]
    answer = result.map("alpha").query(points, map_kind="mean")
    np.testing.assert_array_equal(answer.log_odds, [*LEAVES.log_odds[[0, 1, 3]], [0, 0]])
    assert answer.log_odds.dtype == answer.probabilities.dtype == np.float32
    assert answer.labels.tolist() == [1, 2, 0, 0]
    assert answer.known.tolist() == [True, True, True, False]
    assert answer.sizes.tolist() == [0.2, 0.4, 0.2, 0.0]
    weights = np.exp(np.column_stack([np.zeros(4), answer.log_odds.astype(np.float64)]))
    np.testing.assert_allclose(answer.probabilities, weights / weights.sum(axis=1, keepdims=True), rtol=1e-6)


@pytest.mark.parametrize("points", [[1.0, 2.0, 3.0], [[1.0, 2.0]], np.zeros((2, 2, 3))])
def test_points_with_another_shape_are_refused(result: Result, points: object) -> None:
    with pytest.raises(ValueError, match=r"points: expects an array \(P, 3\)"):
        result.map("alpha").query(points)


def test_query_without_points(result: Result) -> None:
    answer = result.map("alpha").query(np.zeros((0, 3)))
    assert answer.probabilities.shape == (0, 3)
    assert len(answer.labels) == 0


def test_a_box_query_returns_the_overlapping_leaves(result: Result) -> None:
    stored = result.map("alpha")
    found = stored.query_box((0.79, -1, -1), (1.05, 1, 1))
    assert found.centers.tolist() == LEAVES.centers[[1, 2]].tolist()
    # Leaf 0 ends where this box starts, which is no overlap.
    assert len(stored.query_box((0.2, 0.0, 0.0), (0.39, 0.2, 0.2))) == 0
    assert len(stored.query_box((-9, -9, -9), (9, 9, 9))) == 4
    with pytest.raises(ValueError, match="every lower bound"):
        stored.query_box((1, 0, 0), (0, 1, 1))
    with pytest.raises(ValueError, match="two corners of three numbers"):
        stored.query_box((1, 0), (2, 1))


def test_posterior_of_the_robots_that_a_map_is_the_mean_of(result: Result) -> None:
    last, first = result.map("alpha"), result.map("alpha", tick=1)
    assert (last.num_robots, first.num_robots) == (2, 1)
    np.testing.assert_array_equal(last.leaves().log_odds, 2 * LEAVES.log_odds)
    np.testing.assert_array_equal(first.leaves().log_odds, LEAVES.log_odds[:1])
    assert (last.title(), last.title("mean"), first.title()) == ("posterior of 2 robots", "mean of 2 robots", "own map")
    with pytest.raises(ValueError, match="map_kind: 'sum' is not one of posterior, mean"):
        last.leaves(map_kind="sum")


def test_the_posterior_and_the_prior(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leaf_list.install(monkeypatch)
    config = team(tmp_path).with_parameters({"prob_free": 0.6})
    prior = np.log(0.4 / 2 / 0.6)
    with ResultWriter(tmp_path / "out.mcap", config) as writer:
        fill(writer)
        writer.complete(summary([tick_metrics(1)]))
    with open_result(str(tmp_path / "out.mcap")) as opened:
        stored = opened.map("alpha")
    point = [[0.1, 0.1, 0.1], [9.0, 9.0, 9.0]]
    own, whole = stored.query(point, map_kind="mean"), stored.query(point)
    np.testing.assert_allclose(own.log_odds, [LEAVES.log_odds[0] + prior, [prior, prior]], rtol=1e-6)
    np.testing.assert_allclose(whole.log_odds, [2 * LEAVES.log_odds[0] + prior, [prior, prior]], rtol=1e-6)
    np.testing.assert_allclose(own.probabilities[1], [0.6, 0.2, 0.2], rtol=1e-6)
    np.testing.assert_allclose(stored.leaves().log_odds, 2 * LEAVES.log_odds + prior, rtol=1e-6)
    box = stored.query_box((0, 0, 0), (0.2, 0.2, 0.2))
    np.testing.assert_allclose(box.log_odds, whole.log_odds[:1], rtol=1e-6)


def test_errors_in_stored_maps_name_the_file(tmp_path: Path) -> None:
    path = write_result(
        tmp_path, lambda writer: writer.write_state(state("alpha", 0, 1, b"OCTM\1" + bytes(39), key=True))
    )
    with open_result(path) as opened, pytest.raises(PacketError) as caught:
        opened.map("alpha")
    assert str(caught.value) == (
        f"{path}: robot 'alpha': map packet of format version 1, this octoreplay reads version 3; replay the logs again"
    )
