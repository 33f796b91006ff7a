"""Evidence of many scans in an octree, against the reference."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import (
    COUNT_SCANS,
    ScanCaster,
    add_scan,
    clamped_increments,
    unclamped_increments,
)
from octoreplay.records import CloudFrame
from reference.evidence import Evidence, IndexedScan
from reference.hand_made import FACING_X, depth_frame
from reference.scenarios import TeamShape, make_scenario
from reference.sensor import scan_update
from support.long_suite import one_in
from support.octree_factory import cells_of
from support.scans import NUM_CLASSES, SENSOR, expected_cells, random_boxes, sum_of_scans, with_confidences


@pytest.mark.parametrize("increments", ["clamped", "unclamped", "count"])
def test_sums_of_many_scans_equal_the_reference(increments):
    sensor = SensorConfig(max_range=4.0, hit=0.75, miss=-0.5, hit_other=-0.25, clamp_min=-2.0, clamp_max=1.5)
    steps = {
        "clamped": clamped_increments(sensor), "unclamped": unclamped_increments(sensor), "count": COUNT_SCANS,
    }[increments]  # fmt: skip
    num_classes = 1 if increments == "count" else NUM_CLASSES
    scenario = make_scenario(2, TeamShape(num_robots=2, num_ticks=15, image=(12, 9), resolution=0.4, sensors="mixed"))
    region = MapConfig(resolution=0.4)
    octree = sum_of_scans(scenario.frames, steps, num_classes, sensor, region)
    expected = {}
    for frame in scenario.frames:
        freed, hit = expected_cells(frame, sensor, region)
        for key in freed | hit.keys():
            change = np.full(num_classes, steps.miss)
            if key in hit:
                change[:] = steps.hit_other
                if num_classes > 1:
                    change[hit[key] - 1] = steps.hit
                else:
                    change[:] = steps.hit
            expected[key] = np.clip(expected.get(key, np.zeros(num_classes)) + change, steps.least, steps.most)
    # All increments are multiples of 1/4, so that float32 sums are exact.
    assert cells_of(octree) == {key: value.astype(np.float32).tobytes() for key, value in expected.items()}


def _mixed_scenario(confidence):
    """Depth and cloud scans of a team; ``confidence`` returns confidences of a shape, or None for none."""
    scenario = make_scenario(2, TeamShape(num_robots=2, num_ticks=12, image=(12, 9), resolution=0.4, sensors="mixed"))
    frames = []
    for frame in scenario.frames:
        shape = (len(frame.points),) if isinstance(frame, CloudFrame) else frame.depth_image.shape
        given = confidence(shape)
        frames.append(frame if given is None else with_confidences(frame, given))
    return frames


def test_full_confidence_equals_no_confidences():
    """Bit for bit, in evidence and in counts."""
    sensor, region = SensorConfig(max_range=4.0, hit=0.85, miss=-0.41, hit_other=-0.13), MapConfig(0.4)
    plain, sure = _mixed_scenario(lambda _: None), _mixed_scenario(lambda shape: np.full(shape, 255))
    for num_classes, steps in (
        (NUM_CLASSES, clamped_increments(sensor)), (NUM_CLASSES, unclamped_increments(sensor)),
        (1, clamped_increments(sensor)), (1, COUNT_SCANS),
    ):  # fmt: skip
        maps = [cells_of(sum_of_scans(frames, steps, num_classes, sensor, region)) for frames in (plain, sure)]
        assert maps[0] == maps[1]


@pytest.mark.parametrize(("num_classes", "hit_other"), one_in(4, [1, 3, 12], [None, -0.2]))
def test_weighted_sums_of_many_scans_equal_the_reference(num_classes, hit_other):
    """Clamped, unclamped and counted; scans with and without confidences in turn."""
    rng = np.random.default_rng(num_classes)
    sensor = SensorConfig(max_range=4.0, hit=0.9, miss=-0.4, hit_other=hit_other, clamp_min=-2.0, clamp_max=1.5)
    region, frames = MapConfig(0.4), []
    for frame in _mixed_scenario(lambda shape: rng.integers(0, 256, shape) if rng.random() < 0.8 else None):
        labels = "class_ids" if isinstance(frame, CloudFrame) else "class_image"
        ids = getattr(frame, labels)
        ids = np.where(ids > 0, rng.integers(1, num_classes + 1, ids.shape), 0).astype(np.uint8)
        frames.append(dataclasses.replace(frame, **{labels: ids}, boxes=random_boxes(rng, frame, 1)))
    updates = [scan_update(frame, sensor, region) for frame in frames]
    keys = sorted({tuple(key) for update in updates for key in [*update.freed.tolist(), *update.hit.tolist()]})
    place = {key: i for i, key in enumerate(keys)}
    reference = Evidence(len(keys), num_classes)
    for update in updates:
        freed, hit = ([place[tuple(key)] for key in part.tolist()] for part in (update.freed, update.hit))
        scan = IndexedScan(0, 0, np.array(freed, int), np.array(hit, int), update.hit_classes, update.hit_strengths)
        reference.integrate(scan, sensor)
    caster = ScanCaster(sensor, region, num_classes)
    octrees = [SemanticOctree(region.resolution, classes) for classes in (num_classes, num_classes, 1)]
    for frame in frames:
        cells = caster.cast(frame)
        for octree, steps in zip(
            octrees, (clamped_increments(sensor), unclamped_increments(sensor), COUNT_SCANS), strict=True
        ):
            add_scan(octree, cells, steps, 0)
    found = [cells_of(octree) for octree in octrees]
    assert all(sorted(cells) == keys for cells in found)
    values = [np.array([np.frombuffer(cells[key], np.float32) for key in keys]) for cells in found]
    np.testing.assert_allclose(values[0], reference.clamped[:, 1:], atol=1e-5)
    np.testing.assert_allclose(values[1], reference.total[:, 1:], atol=1e-5)
    np.testing.assert_array_equal(values[2][:, 0], reference.num_touching_scans)


def test_one_class_and_254_classes():
    pose = np.eye(4)
    pose[:3, :3] = FACING_X
    for num_classes, class_id in ((1, 1), (254, 254), (254, 1)):
        frame = depth_frame(np.array([[2.0]], np.float32), [[class_id]])
        octree = SemanticOctree(1.0, num_classes)
        caster = ScanCaster(SENSOR, MapConfig(resolution=1.0), num_classes)
        add_scan(octree, caster.cast(frame), clamped_increments(SENSOR), 3)
        values = np.frombuffer(cells_of(octree)[2, 0, 0], np.float32)
        expected = np.full(num_classes, -0.3, np.float32)
        expected[class_id - 1] = 1.0
        np.testing.assert_array_equal(values, expected)
        assert octree.revisions.tolist() == [3]


def test_saturated_free_space_becomes_uniform_and_does_not_change():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4000, 3))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * 3.9
    pose = np.eye(4)
    pose[:3, 3] = 0.8
    frame = CloudFrame("r", 0, points, np.zeros(len(points), np.uint8), pose)
    octree = sum_of_scans([frame] * 20, clamped_increments(SENSOR))
    centre = octree.find(np.array([storage.key_to_code(0, 0, 0) >> storage.CELL_BITS]))[0]
    assert octree.bricks.blocks[centre] == -1
    assert octree.bricks.values[centre] == -5.0
    assert octree.revisions[centre] < 19
