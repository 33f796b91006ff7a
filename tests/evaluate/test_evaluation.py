"""Evaluations of small results with known scores, and of a recorded team."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from octoreplay import Evaluation, evaluate_result, load_team_file, open_result, replay_team, resolve
from octoreplay.errors import ConfigError, InputError
from octoreplay.evaluate.evaluation import truth_beside_logs
from octoreplay.evaluate.records import MAP_SCORES, SCORES, MapScores
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.mapping.codec import encode_packet
from octoreplay.records import CENTRAL
from support import dense_scores
from support.long_suite import long
from support.octree_factory import cells_of, cube, octree_of
from support.result_factory import state, summary, team, tick_metrics, write_killed, write_result

FIXTURES = Path(__file__).parents[1] / "fixtures"
FREE, GROUND, TREE = (-2.0, -2.0), (3.0, -1.5), (-1.2, 2.3)
Cells = Mapping[tuple[int, ...], tuple[float, float]]

HALF: Cells = cube((0, 0, 0), 4, FREE) | {(k, 0, 0): GROUND for k in range(4)}
WHOLE: Cells = cube((0, 0, 0), 8, FREE) | {(k, 0, 0): GROUND for k in range(8)}
TRUTH = {(k, 0, 0): 1 for k in range(10)} | {(0, 0, 9): 2}


def packet(cells: Cells) -> bytes:
    return encode_packet(octree_of(cells, resolution=0.2))


def save_result(folder: Path, ticks: Mapping[int, Mapping[str, Cells]]) -> Path:
    """A result with maps stored as key frames, {tick: {robot: cells}}."""
    folder.mkdir(exist_ok=True)

    def fill(writer: ResultWriter) -> None:
        for sequence, (tick, maps) in enumerate(sorted(ticks.items())):
            for name, cells in maps.items():
                num_robots = 1 if name == CENTRAL else 2
                writer.write_state(state(name, sequence, tick, packet(cells), key=True, num_robots=num_robots))

    return write_result(folder, fill)


def save_truth(folder: Path, classes: Mapping[tuple[int, ...], int] = TRUTH, shift: int = 0) -> Path:
    keys = np.array(list(classes), np.int32) + np.array([0, 0, shift], np.int32)
    np.savez(
        folder / "world.npz", keys=keys, class_ids=np.array(list(classes.values()), np.uint8),
        resolution=np.float64(0.2), class_names=np.array(["ground", "tree"]),
    )  # fmt: skip
    return folder / "world.npz"


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """A result in which alpha knows half of beta's cells after tick 2, and all of them after tick 4."""
    return save_result(
        tmp_path,
        {2: {"alpha": HALF, "beta": WHOLE, CENTRAL: WHOLE}, 4: {"alpha": WHOLE, "beta": WHOLE, CENTRAL: WHOLE}},
    )


def scores(evaluation: Evaluation, robot_id: str, tick: int = -1) -> MapScores:
    """Scores of one map at one of the stored ticks."""
    return next(entry for entry in evaluation.ticks[tick].maps if entry.robot_id == robot_id)


def same(a: object, b: object) -> bool:
    """Equality in which NaN equals NaN."""
    return repr(a) == repr(b)


def test_scores_at_every_stored_tick(result: Path, tmp_path: Path) -> None:
    done: list[float] = []
    evaluation = evaluate_result(result, truth=save_truth(tmp_path), progress=done.append)
    assert evaluation.class_names == ("ground", "tree")
    assert [(tick.tick, tick.seconds) for tick in evaluation.ticks] == [(2, 2.0), (4, 4.0)]
    assert (len(done), done[-1]) == (2, 1.0)
    alpha, beta, central = evaluation.ticks[0].maps
    assert (alpha.robot_id, beta.robot_id, central.robot_id) == ("alpha", "beta", CENTRAL)
    # Alpha lacks half of the cells of the team; all cells that it knows are right.
    assert (alpha.truth.iou[0], alpha.truth.mean_iou, alpha.truth.mean_iou_known) == (0.5, 0.5, 1.0)
    assert (alpha.truth.coverage, beta.truth.coverage) == (0.5, 1.0)
    assert (alpha.truth.world_coverage, beta.truth.world_coverage) == (4 / 11, 8 / 11)
    assert (alpha.num_cells, beta.num_cells) == (64, 512)
    assert (alpha.agreement, alpha.agreement_occupied) == (64 / 512, 0.5)
    assert (beta.agreement, beta.agreement_occupied, central.agreement) == (1.0, 1.0, 1.0)
    assert (alpha.truth.occupied_accuracy, alpha.truth.free_accuracy) == (1.0, 1.0)
    assert math.isnan(alpha.truth.iou[1])
    assert evaluation.ticks[0].label_disagreement == (512 - 64) / 512
    assert evaluation.final.label_disagreement == 0.0
    final = scores(evaluation, "alpha")
    assert same(dataclasses.replace(final, robot_id="beta"), scores(evaluation, "beta"))
    assert final.truth.mean_iou == final.agreement == final.truth.coverage == 1.0


@pytest.mark.parametrize("map_kind", ["posterior", "mean"])
def test_entropy_and_calibration_of_the_distributions(result: Path, tmp_path: Path, map_kind: str) -> None:
    evaluation = evaluate_result(result, truth=save_truth(tmp_path), map_kind=map_kind)
    assert evaluation.map_kind == map_kind
    classes = {key: 1 for key in TRUTH if TRUTH[key] == 1}
    for name in ("alpha", CENTRAL):
        num_robots = 2 if (name, map_kind) == ("alpha", "posterior") else 1
        entropies = []
        for values in WHOLE.values():
            distribution = dense_scores.probabilities(values, 0.0, num_robots)
            entropies.append(-np.sum(distribution * np.log2(distribution)))
        found = scores(evaluation, name)
        assert found.entropy_bits == pytest.approx(np.mean(entropies), abs=1e-6)
        expected = [
            dense_scores.calibration_error(WHOLE, classes, 0.0, num_robots, occupied=occupied)
            for occupied in (False, True)
        ]
        assert [found.truth.calibration_error, found.truth.calibration_error_occupied] == pytest.approx(
            expected, abs=1e-6
        )


def test_an_unknown_form_of_the_maps_is_refused(result: Path) -> None:
    with pytest.raises(ConfigError, match="map: 'sum' is not one of posterior, mean"):
        evaluate_result(result, map_kind="sum")


def test_the_posterior_has_its_own_labels(tmp_path: Path) -> None:
    # With this prior, the mean 0.7 of two robots leaves the cell free, and the posterior makes it occupied.
    config = team(tmp_path).with_parameters({"prob_free": 0.5})
    cells, path = {(0, 0, 0): (-2.0, 0.6), (1, 0, 0): (-2.0, -2.0)}, tmp_path / "prior.mcap"
    with ResultWriter(path, config) as writer:
        writer.write_metrics(tick_metrics(1))
        for robot_id in ("alpha", "beta"):
            writer.write_state(state(robot_id, 0, 1, packet(cells), key=True, num_robots=2))
        writer.complete(summary([tick_metrics(1)]))
    truth = save_truth(tmp_path, {(0, 0, 0): 2})
    for map_kind, found in (("posterior", 1.0), ("mean", 0.0)):
        assert scores(evaluate_result(path, truth=truth, map_kind=map_kind), "alpha").truth.occupied_accuracy == found


def test_the_last_tick_only_equals_the_end_of_the_history(result: Path, tmp_path: Path) -> None:
    truth = save_truth(tmp_path)
    evaluation = evaluate_result(result, truth=truth, over_time=False)
    assert same(evaluation.ticks, evaluate_result(result, truth=truth).ticks[-1:])


def test_a_robot_without_a_stored_map_has_an_empty_map(tmp_path: Path) -> None:
    path = save_result(tmp_path, {2: {"beta": WHOLE, CENTRAL: WHOLE}, 4: {"alpha": WHOLE, "beta": WHOLE}})
    evaluation = evaluate_result(path, truth=save_truth(tmp_path))
    alpha = scores(evaluation, "alpha", 0)
    assert (alpha.num_cells, alpha.agreement, alpha.truth.mean_iou, alpha.truth.coverage) == (0, 0.0, 0.0, 0.0)
    assert math.isnan(alpha.truth.free_accuracy)
    assert evaluation.ticks[0].label_disagreement == 1.0


def test_scores_without_a_truth(result: Path) -> None:
    evaluation = evaluate_result(str(result))
    assert evaluation.truth is None
    alpha = scores(evaluation, "alpha", 0)
    assert alpha.truth is None
    assert len(evaluation.iou(alpha)) == 2
    assert np.isnan([*evaluation.iou(alpha), *map(alpha.score, set(SCORES) - set(MAP_SCORES))]).all()
    assert alpha.agreement == 64 / 512


def test_agreement_without_a_stored_centralised_map_is_that_of_the_run(tmp_path: Path) -> None:
    path = save_result(tmp_path, {2: {"alpha": HALF, "beta": WHOLE}, 4: {"alpha": WHOLE, "beta": WHOLE}})
    evaluation = evaluate_result(path, truth=save_truth(tmp_path))
    assert evaluation.final.central is None
    with open_result(path) as opened:
        for tick in evaluation.ticks:
            stored = next(metrics for metrics in opened.metrics if metrics.tick == tick.tick)
            assert [entry.agreement for entry in tick.maps] == [robot.agreement for robot in stored.robots]
            assert [entry.agreement_occupied for entry in tick.maps] == [r.agreement_occupied for r in stored.robots]
    # The cells that any robot knows take the place of the team's evidence.
    assert scores(evaluation, "alpha", 0).truth.mean_iou == 0.5


# --- against another result -------------------------------------------------------------------------------------------


def test_a_result_agrees_with_itself(result: Path, tmp_path: Path) -> None:
    own, other = evaluate_result(result), evaluate_result(result, against=result)
    assert same(own.ticks, other.ticks)
    assert (own.against, other.against) == (CENTRAL, str(result))
    assert scores(other, CENTRAL, 0).agreement == scores(other, CENTRAL, 0).agreement_occupied == 1.0


def test_agreement_with_a_shifted_result(result: Path, tmp_path: Path) -> None:
    shifted = {(x, y, z + 1): values for (x, y, z), values in WHOLE.items()}
    other = save_result(tmp_path / "other", {2: {"alpha": HALF, CENTRAL: shifted}})
    evaluation = evaluate_result(result, against=other)
    beta = scores(evaluation, "beta", 0)
    # Nine layers of 64 cells; seven are common, and in one of these 8 cells are ground in the other result only.
    assert beta.agreement == (7 * 64 - 8) / (9 * 64)
    assert beta.agreement_occupied == 0.0
    # The other result's last map is the reference at all later times.
    assert scores(evaluation, CENTRAL).agreement == beta.agreement


def test_the_reference_is_the_other_map_at_the_same_time(result: Path, tmp_path: Path) -> None:
    other = save_result(tmp_path / "other", {3: {"alpha": HALF, CENTRAL: HALF}, 4: {"alpha": HALF, CENTRAL: WHOLE}})
    evaluation = evaluate_result(result, against=other)
    assert math.isnan(scores(evaluation, "beta", 0).agreement)
    assert scores(evaluation, "beta").agreement == 1.0


def test_a_reference_with_other_classes_or_resolution_is_refused(result: Path, tmp_path: Path) -> None:
    bare = save_result(tmp_path / "bare", {2: {"alpha": HALF}})
    with pytest.raises(InputError, match=r"bare/result\.mcap: holds no centralised map"):
        evaluate_result(result, against=bare)
    config = resolve(load_team_file(FIXTURES / "pair" / "team.yaml")).with_parameters({"duration": 0.5})
    replay_team(config, tmp_path / "pair.mcap")
    with pytest.raises(InputError, match=r"pair\.mcap: classes differ from .*result\.mcap"):
        evaluate_result(result, against=tmp_path / "pair.mcap")
    replay_team(config.with_parameters({"resolution": 0.4}), tmp_path / "coarse.mcap")
    with pytest.raises(InputError, match=r"coarse\.mcap: resolution differs from .*pair\.mcap"):
        evaluate_result(tmp_path / "pair.mcap", against=tmp_path / "coarse.mcap")
    with pytest.raises(InputError, match=r"none\.mcap: cannot be read"):
        evaluate_result(result, against=tmp_path / "none.mcap")


# --- refused inputs ---------------------------------------------------------------------------------------------------


def test_a_truth_outside_the_maps_is_refused(result: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"world\.npz: no surface lies in the cells that the maps of .* know"):
        evaluate_result(result, truth=save_truth(tmp_path, shift=100))


def test_a_result_without_maps_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"result\.mcap: holds no map"):
        evaluate_result(write_result(tmp_path))


def test_maps_without_metrics_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"result\.mcap: damaged: tick 9 has maps but no metrics"):
        evaluate_result(save_result(tmp_path, {9: {"alpha": WHOLE, "beta": WHOLE, CENTRAL: WHOLE}}))


def test_an_interrupted_run_without_a_tick_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no map; the run was interrupted before it stored one"):
        evaluate_result(write_killed(tmp_path / "empty.mcap", []))


# --- a recorded team --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of the team pair, with a prior that is not uniform."""
    config = resolve(load_team_file(FIXTURES / "pair" / "team.yaml"))
    path = tmp_path_factory.mktemp("pair") / "pair.mcap"
    replay_team(config.with_parameters({"state_every": 1.0, "prob_free": 0.2, "rule": "bayes"}), path)
    return path


def test_scores_equal_the_metrics_of_the_run(pair: Path) -> None:
    evaluation, of_mean = evaluate_result(pair), evaluate_result(pair, map_kind="mean")
    assert len(evaluation.ticks) > 3
    with open_result(pair) as opened:
        by_tick = {metrics.tick: metrics for metrics in opened.metrics}
    # All maps are empty at the first tick.
    first = evaluation.ticks[0]
    assert np.isnan(
        [first.label_disagreement, *(value for m in first.maps for value in (m.agreement, m.agreement_occupied))]
    ).all()
    for tick in evaluation.ticks[1:]:
        stored = by_tick[tick.tick]
        assert tick.label_disagreement == stored.label_disagreement
        for found, robot in zip(tick.maps, stored.robots, strict=False):
            assert (found.robot_id, found.is_active, found.num_cells) == (robot.robot_id, robot.active, robot.num_cells)
            assert (found.agreement, found.agreement_occupied) == (robot.agreement, robot.agreement_occupied)
    for tick in of_mean.ticks[1:]:
        for found, robot in zip(tick.maps, by_tick[tick.tick].robots, strict=False):
            assert found.entropy_bits == pytest.approx(robot.entropy_bits)
    again = evaluate_result(pair, against=pair)
    for own, other in zip(evaluation.ticks[1:], again.ticks[1:], strict=True):
        assert [entry.agreement for entry in own.maps] == pytest.approx([entry.agreement for entry in other.maps])
        assert [entry.agreement_occupied for entry in own.maps] == pytest.approx(
            [entry.agreement_occupied for entry in other.maps]
        )


@long
def test_a_recorded_team_against_its_truth_cell_by_cell(pair: Path) -> None:
    evaluation = evaluate_result(pair, truth=FIXTURES / "pair", over_time=False)
    with np.load(FIXTURES / "pair" / "world.npz") as world, open_result(pair) as opened:
        classes = dict(zip(map(tuple, world["keys"].tolist()), world["class_ids"].tolist(), strict=True))
        maps = {name: opened.map(name) for name in (opened.robots[0], CENTRAL)}
        num_classes, prior = opened.class_table.num_classes, maps[CENTRAL].prior
    team = cells_of(maps[CENTRAL].octree)
    for name, stored in maps.items():
        found = scores(evaluation, name)
        # The posterior of two robots; the centralised map is one already.
        factor = np.float32(1 if name == CENTRAL else 2)
        cells = {
            key: tuple((factor * np.frombuffer(data, np.float32)).tolist())
            for key, data in cells_of(stored.octree).items()
        }
        assert found.truth.iou == pytest.approx(dense_scores.iou(cells, team, classes, prior), nan_ok=True)
        assert len(found.truth.iou) == num_classes
        assert (found.truth.occupied_accuracy, found.truth.free_accuracy) == pytest.approx(
            dense_scores.accuracies(cells, classes, prior)
        )
        assert found.truth.coverage == pytest.approx(dense_scores.coverage(cells, team, classes, prior))
        assert found.truth.world_coverage == pytest.approx(dense_scores.coverage(cells, classes, classes, prior))
        assert found.truth.calibration_error == pytest.approx(
            dense_scores.calibration_error(cells, classes, prior, 1), abs=1e-4
        )
    assert 0.2 < found.truth.mean_iou < 1.0
    assert found.truth.coverage > 0.4


def test_the_truth_beside_the_logs_is_found(pair: Path, result: Path) -> None:
    found = truth_beside_logs(pair)
    assert found is not None
    assert found.resolve() == FIXTURES / "pair" / "world.npz"
    assert truth_beside_logs(result) is None
