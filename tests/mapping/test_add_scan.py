"""Evidence of many scans in an octree, against the reference."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import (
    COUNT_SCANS,
    Increments,
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

MODELS = ("none", "hit", "tempered", "mixture")


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


@pytest.mark.parametrize("model", MODELS)
def test_full_confidence_equals_no_confidences(model):
    """Bit for bit, in evidence and in counts."""
    sensor = SensorConfig(max_range=4.0, hit=0.85, miss=-0.41, hit_other=-0.13, confidence_model=model)
    region = MapConfig(0.4)
    plain, sure = _mixed_scenario(lambda _: None), _mixed_scenario(lambda shape: np.full(shape, 255))
    for num_classes, steps in (
        (NUM_CLASSES, clamped_increments(sensor)), (NUM_CLASSES, unclamped_increments(sensor)),
        (1, clamped_increments(sensor)), (1, COUNT_SCANS),
    ):  # fmt: skip
        maps = [cells_of(sum_of_scans(frames, steps, num_classes, sensor, region)) for frames in (plain, sure)]
        assert maps[0] == maps[1]


@pytest.mark.parametrize(
    ("num_classes", "hit_other", "model"), one_in(4, [1, 3, 12], [None, -0.2, 0.0], ["hit", "tempered", "mixture"])
)
def test_weighted_sums_of_many_scans_equal_the_reference(num_classes, hit_other, model):
    """Clamped, unclamped and counted; scans with and without confidences in turn."""
    rng = np.random.default_rng(num_classes)
    sensor = SensorConfig(
        max_range=4.0, hit=0.9, miss=-0.4, hit_other=hit_other, clamp_min=-2.0, clamp_max=1.5, confidence_model=model
    )
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


def test_ignored_confidences_equal_no_confidences():
    """Bit for bit, also of points with confidence 0."""
    sensor, region = SensorConfig(max_range=4.0, confidence_model="none"), MapConfig(0.4)
    rng = np.random.default_rng(0)
    plain, unsure = _mixed_scenario(lambda _: None), _mixed_scenario(lambda shape: rng.integers(0, 256, shape))
    maps = [
        cells_of(sum_of_scans(frames, clamped_increments(sensor), NUM_CLASSES, sensor, region))
        for frames in (plain, unsure)
    ]
    assert maps[0] == maps[1]


@given(
    st.sampled_from(MODELS), st.floats(0.01, 5.0), st.floats(-3.0, 0.0), st.integers(2, 254),
    st.sampled_from([0.0, 2.0**-16]),
)  # fmt: skip
def test_increments_of_each_strength(model, hit, hit_other, num_classes, quantum):
    hit, hit_other = (round(value * 2**16) / 2**16 for value in (hit, hit_other))
    steps = Increments(hit, -0.3, hit_other, -5.0, 5.0, model, quantum)
    hits, others = steps.by_strength(num_classes)
    assert (hits.dtype, others.dtype) == (np.float32, np.float32)
    assert (hits[255], others[255]) == (np.float32(hit), np.float32(hit_other))
    # A surer label raises its class, against the others too.
    assert (np.diff(hits) >= 0).all()
    assert (np.diff(hits - others) >= -1e-6 - 2 * quantum).all()
    if quantum:
        assert not (np.concatenate([hits, others]).astype(float) % quantum).any()
    if model == "tempered":
        # The same ratios, as of a fraction of a hit.
        np.testing.assert_allclose(others * hit, hits * hit_other, atol=1e-5 + 5 * quantum)
    if model == "mixture":
        # Only the class is uncertain: the likelihood of a surface stays.
        total = np.exp(hits.astype(float)) + (num_classes - 1) * np.exp(others.astype(float))
        np.testing.assert_allclose(total, total[255], rtol=1e-5 + quantum)
        # With as much doubt as without any label, all classes are equal.
        fair = 255 // num_classes
        if 255 % num_classes == 0:
            assert hits[fair] == pytest.approx(others[fair], abs=1e-5 + quantum)


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
