from __future__ import annotations

import itertools

import numpy as np
import pytest

from octoreplay.records import CloudFrame, DepthFrame
from reference.scenarios import CLASS_NAMES, GRASS, GROUND_HEIGHT, Scene, TeamShape, make_scenario
from reference.twin import Twin, record

ONE_BOX = Scene(np.array([[2.0, -1.0, 0.0]]), np.array([[3.0, 1.0, 2.0]]), np.array([3]))


def test_scene_is_cast_in_closed_form():
    origin = np.array([0.0, 0.0, 1.0])
    directions = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.5], [0.0, 2.0, -0.5], [0.0, 0.0, 1.0]])
    t, classes = ONE_BOX.cast(origin, directions)
    np.testing.assert_allclose(t, [2.0, 1.0, 2.0 * (1.0 - GROUND_HEIGHT), np.inf])
    assert classes[:3].tolist() == [3, 3, GRASS]


def test_frames_depend_on_the_seed():
    shape = TeamShape(num_robots=2, num_ticks=4, image=(6, 4), sensors="mixed")
    first, second, other = (make_scenario(seed, shape) for seed in (3, 3, 4))
    assert [frame.stamp_ns for frame in first.frames] == [frame.stamp_ns for frame in second.frames]
    for a, b in zip(first.frames, second.frames, strict=True):
        assert isinstance(a, DepthFrame)
        np.testing.assert_array_equal(a.depth_image, b.depth_image)
        np.testing.assert_array_equal(a.class_image, b.class_image)
        np.testing.assert_array_equal(a.T_team_sensor, b.T_team_sensor)
    assert not np.array_equal(first.frames[0].T_team_sensor, other.frames[0].T_team_sensor)


def test_images_have_noise_labels_and_gaps():
    scenario = make_scenario(0, TeamShape(num_robots=3, num_ticks=10, sensors="mixed"))
    kinds = {frame.robot_id: frame for frame in scenario.frames}
    assert isinstance(kinds["robot_2"], CloudFrame)
    assert kinds["robot_0"].depth_image.dtype == np.uint16
    assert kinds["robot_1"].depth_image.dtype == np.float32
    depths = np.concatenate([f.depth_image.ravel() for f in scenario.frames if f.robot_id == "robot_0"])
    assert (depths == 0).any()
    assert (depths == 65535).any()
    classes = np.concatenate([f.class_image.ravel() for f in scenario.frames if f.robot_id == "robot_0"])
    assert set(np.unique(classes)) == set(range(len(CLASS_NAMES) + 1))


def test_configurations_take_flat_parameters_and_edges():
    scenario = make_scenario(0, TeamShape(num_robots=2, num_ticks=3, image=(4, 3)))
    config = scenario.config(rule="bayes", topology="edges", weights="given", edges=(("robot_0", "robot_1", 0.4),))
    assert (config.consensus.rule, config.network.topology) == ("bayes", "edges")
    assert config.map.resolution == TeamShape().resolution


@pytest.mark.long
@pytest.mark.parametrize("num_robots", [4, 6])
def test_default_teams_are_large_enough(num_robots):
    """At least 100 ticks and 20,000 cells, overlapping views, saturated cells, evidence throughout, late and early."""
    scenario = make_scenario(1, TeamShape(num_robots=num_robots))
    config = scenario.config(rule="local", settle=0)
    recording = record(config, scenario.frames)
    ticks = list(_thin(Twin(config, recording, with_metrics=False).ticks()))
    assert len(ticks) >= 100
    assert len(recording.keys) >= 20_000
    scans, active, last = [tick[0] for tick in ticks], [tick[1] for tick in ticks], ticks[-1][2]
    assert all(sum(after) > sum(before) for before, after in itertools.pairwise(scans))
    assert not active[20][-1]
    assert active[50][-1]
    assert scans[70][-2] == scans[-1][-2]
    num_seers = last.known.sum(axis=0)
    assert (num_seers >= 2).mean() > 0.3
    assert (last.known.mean(axis=1) < 0.6).all()
    saturated = (np.abs(last.evidence[..., 1:]) >= 5.0).any(axis=2)
    assert (saturated.sum(axis=1) > 1000).all()
    assert (last.evidence[..., 1:].max(axis=2) >= 5.0).any()
    on_a_tick = [(frame.stamp_ns - scenario.frames[0].stamp_ns) % 10**9 == 0 for frame in scenario.frames]
    assert sum(on_a_tick) > 20


def _thin(ticks):
    """(scans, active, the tick itself for the last one) of every tick, so that not all maps are kept at once."""
    previous = None
    for tick in ticks:
        if previous is not None:
            yield previous.num_scans, previous.active, None
        previous = tick
    yield previous.num_scans, previous.active, previous
