"""Memory layouts, confidences, robots' bodies and lenses of scans, against the reference."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.sensor import MapConfig
from octoreplay.mapping.kernels import ends
from octoreplay.mapping.sensor import (
    ScanCaster,
    clamped_increments,
)
from octoreplay.records import BodyBox, CameraModel, CloudFrame
from reference.hand_made import cloud, depth_frame, facing_x
from reference.scenarios import TeamShape, make_scenario
from support.long_suite import examples, one_in
from support.octree_factory import cells_of
from support.scans import (
    MAP,
    NUM_CLASSES,
    SENSOR,
    cells_of_scan,
    check_scan,
    random_boxes,
    random_cloud,
    random_depth,
    random_pose,
    read_only_copy,
    strided,
    sum_of_scans,
    weighted_cells,
    with_confidences,
)

# --- layouts of the input --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", one_in(2, [np.uint16, np.float32]))
def test_memory_layout_of_images_does_not_change_the_result(dtype):
    frame = random_depth(np.random.default_rng(1), dtype)
    expected = cells_of_scan(frame)
    for layout in (np.asfortranarray, strided, lambda a: a[::-1][::-1], lambda a: read_only_copy(a)):
        other = dataclasses.replace(
            frame, depth_image=layout(frame.depth_image), class_image=layout(frame.class_image),
            T_team_sensor=np.asfortranarray(frame.T_team_sensor),
        )  # fmt: skip
        assert cells_of_scan(other) == expected
    big_endian = dataclasses.replace(
        frame, depth_image=frame.depth_image.astype(frame.depth_image.dtype.newbyteorder(">"))
    )
    assert cells_of_scan(big_endian) == expected
    assert cells_of_scan(
        dataclasses.replace(frame, T_team_sensor=frame.T_team_sensor.astype(np.float32))
    ) == cells_of_scan(
        dataclasses.replace(frame, T_team_sensor=frame.T_team_sensor.astype(np.float32).astype(np.float64))
    )


@pytest.mark.parametrize("dtype", one_in(2, [np.float32, np.float64]))
def test_memory_layout_of_clouds_does_not_change_the_result(dtype):
    frame = random_cloud(np.random.default_rng(2), dtype)
    expected = cells_of_scan(frame)
    for layout in (np.asfortranarray, strided, lambda a: a[::-1][::-1], read_only_copy):
        other = dataclasses.replace(frame, points=layout(frame.points), class_ids=layout(frame.class_ids))
        assert cells_of_scan(other) == expected
    swapped = dataclasses.replace(frame, points=frame.points.astype(frame.points.dtype.newbyteorder(">")))
    assert cells_of_scan(swapped) == expected


def test_reused_caster_equals_a_new_one():
    """Its scratch grid grows, shrinks and moves; no marks of an earlier scan may remain."""
    scenario = make_scenario(3, TeamShape(num_robots=2, num_ticks=12, image=(12, 9), sensors="mixed"))
    caster = ScanCaster(SENSOR, MAP, NUM_CLASSES)
    rng = np.random.default_rng(0)
    for frame in scenario.frames:
        moved = dataclasses.replace(frame, T_team_sensor=random_pose(rng, spread=50.0))
        assert cells_of_scan(moved, caster=caster) == cells_of_scan(moved)


def _random_slopes(rng, size, holes=0.05):
    """Slopes of a lens with distortion, NaN at some pixels."""
    v, u = np.mgrid[: size[0], : size[1]]
    slopes = np.stack([(u - size[1] / 2) / 9.0, (v - size[0] / 2) / 8.5])
    slopes *= 1.0 + rng.uniform(-0.3, 0.5) * (slopes**2).sum(axis=0)
    slopes[:, rng.random(size) < holes] = np.nan
    return slopes.astype(np.float32)


def _random_frame(seed, num_classes, kind, *, confident, num_boxes, bent):
    """A scan with several points in a cell and the requested extras, and a sensor that cuts some of its rays."""
    rng = np.random.default_rng(seed)
    if kind == "cloud":
        # Clouds are processed in blocks of 1024 points.
        frame = random_cloud(rng, rng.choice([np.float32, np.float64]), size=int(rng.choice([300, 1300])))
    else:
        frame = random_depth(rng, np.float32 if kind == "depth32" else np.uint16)
        frame.depth_image[rng.random(frame.depth_image.shape) < 0.05] = 7
    labels = "class_ids" if kind == "cloud" else "class_image"
    shape = getattr(frame, labels).shape
    frame = dataclasses.replace(frame, **{labels: rng.integers(0, num_classes + 1, shape).astype(np.uint8)})
    if bent and kind != "cloud":
        camera = dataclasses.replace(frame.camera, slopes=_random_slopes(rng, shape))
        frame = dataclasses.replace(frame, camera=camera)
    if confident:
        few = rng.random() < 0.5
        frame = with_confidences(frame, rng.choice([0, 1, 2, 127, 128, 255] if few else np.arange(256), shape))
    return dataclasses.replace(frame, boxes=random_boxes(rng, frame, num_boxes))


@examples(120)
@given(
    seed=st.integers(0, 2**32 - 1),
    num_classes=st.sampled_from([1, 3, 12]),
    kind=st.sampled_from(["depth16", "depth32", "cloud"]),
    rays=st.sampled_from(["cells", "all"]),
    confident=st.booleans(),
    num_boxes=st.integers(0, 4),
    bent=st.booleans(),
    resolution=st.sampled_from([0.2, 0.5, 1.3]),
)
def test_random_scans_with_confidences_boxes_and_lenses(
    seed, num_classes, kind, rays, confident, num_boxes, bent, resolution
):
    sensor = dataclasses.replace(SENSOR, rays=rays, min_range=0.4, no_return_depth=(7.0,), invalid_depth=(0.0,))
    frame = _random_frame(seed, num_classes, kind, confident=confident, num_boxes=num_boxes, bent=bent)
    check_scan(frame, sensor, MapConfig(resolution), num_classes)


def test_labels_are_weighted_by_their_confidences():
    near = np.array([[2.0, 0.0, 0.0]]) + np.arange(5)[:, None] * 1e-3
    for class_ids, confidences, winner in (
        ([4, 4, 2, 0, 0], [50, 60, 111, 255, 255], (2, 111)),
        ([4, 4, 2, 0, 0], [50, 60, 110, 255, 255], (2, 110)),
        ([4, 4, 2, 0, 0], [50, 60, 109, 255, 255], (4, 55)),
        ([4, 4, 2, 4, 2], [50, 61, 0, 0, 0], (4, 56)),
        ([3, 3, 3, 3, 3], [1, 0, 2, 2, 0], (3, 2)),
        ([3, 3, 3, 3, 3], [1, 0, 1, 2, 0], (3, 1)),
    ):
        frame = with_confidences(cloud(near, class_ids), confidences)
        assert list(weighted_cells(frame)[1].values()) == [winner]
        check_scan(frame)


@pytest.mark.parametrize("rays", ["cells", "all"])
def test_points_with_zero_confidence_free_their_ray_and_hit_nothing(rays):
    sensor = dataclasses.replace(SENSOR, rays=rays)
    for frame in (cloud([[2.0, 0, 0]], [1]), cloud([[2.0, 0, 0]], None), depth_frame(np.array([[2.0]], np.float32))):
        shape = (1,) if isinstance(frame, CloudFrame) else (1, 1)
        freed, hit = check_scan(with_confidences(frame, np.zeros(shape)), sensor, MapConfig(0.25))
        assert len(freed) == 8
        assert not hit


def test_sums_of_confidences_beyond_int32():
    """Sums of two classes in one cell exceed 2^31 and differ by 1."""
    lengths = np.full(4, 8_000_000, np.int32)
    sums = 255 * lengths
    lengths[3], sums[3] = lengths[3] + 1, sums[3] + 1
    kinds, places, table = np.array([1, 2, 1, 2], np.uint8), np.zeros(4, np.uint32), np.full(8, -1, np.int32)
    open_places, votes, vote_sums = np.zeros(1, np.uint32), np.zeros((1, 2), np.int32), np.zeros((1, 2), np.int64)
    marks, strengths, end_marks = np.array([1, 0], np.uint8), np.zeros(2, np.uint8), np.zeros(1, np.uint8)
    ends.settle_ends(
        places,
        kinds,
        lengths,
        sums,
        4,
        2,
        table,
        open_places,
        votes,
        vote_sums,
        marks,
        strengths,
        places[:1],
        end_marks,
    )
    assert (marks[0], strengths[0], end_marks[0]) == (3, 255, 3)
    assert vote_sums.tolist() == [[4_080_000_000, 4_080_000_001]]


def _box(low, high, *, is_own, pose=None):
    return BodyBox(np.array(low, float), np.array(high, float), np.eye(4) if pose is None else pose, is_own)


@pytest.mark.parametrize("rays", ["cells", "all"])
def test_points_on_robots_bodies(rays):
    """The point is at (2.5, 0.5, 0.5); its ray passes cells of 0.25 m."""
    sensor = dataclasses.replace(SENSOR, rays=rays)
    other, own = _box([2.5, 0, 0], [3, 0.5, 1], is_own=False), _box([2, 0.5, 0.5], [2.5, 0.5, 0.5], is_own=True)
    beside = _box([2.5 + 1e-9, 0, 0], [3, 1, 1], is_own=True)
    for frame in (cloud([[2.0, 0, 0]], [1]), depth_frame(np.array([[2.0]], np.float32))):
        for boxes, num_freed, num_hits in (
            ((), 8, 1), ((beside,), 8, 1), ((other,), 8, 0), ((own,), 0, 0), ((own, other), 0, 0), ((other, own), 0, 0),
            ((beside, other), 8, 0),
        ):  # fmt: skip
            freed, hit = check_scan(dataclasses.replace(frame, boxes=boxes), sensor, MapConfig(0.25))
            assert (len(freed), len(hit)) == (num_freed, num_hits)


@pytest.mark.parametrize("is_own", [True, False])
def test_boxes_do_not_affect_cut_rays(is_own):
    everywhere = _box([-99] * 3, [99] * 3, is_own=is_own)
    for frame in (cloud([[9.0, 0, 0]], [1]), depth_frame(np.array([[9.0]], np.float32))):
        freed, hit = check_scan(dataclasses.replace(frame, boxes=(everywhere,)), SENSOR, MapConfig(0.25))
        assert (len(freed), hit) == (16, {})


def test_boxes_are_transformed_to_their_frame():
    T_box_team = np.linalg.inv(facing_x(2.5, 0.5, 0.5))
    # The box is 1/8 m thick along its frame's z, which is the team's x.
    ahead = _box([0, 0, 0], [0, 0, 0.125], is_own=True, pose=T_box_team)
    points = [[2.0, 0, 0], [2.125, 0, 0], [2.0, 0.125, 0], [2.0, 0, 0.125]]
    hits = [check_scan(dataclasses.replace(cloud([point], [1]), boxes=(ahead,)))[1] for point in points]
    assert [len(hit) for hit in hits] == [0, 0, 1, 1]


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
@pytest.mark.parametrize("rays", ["cells", "all"])
def test_image_with_distortion_equals_the_cloud_of_its_points(dtype, rays):
    """The maps are equal bit for bit, with boxes and confidences."""
    sensor, region = dataclasses.replace(SENSOR, rays=rays), MapConfig(0.3)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        frame = random_depth(rng, dtype)
        shape = frame.depth_image.shape
        slopes = _random_slopes(rng, shape)
        confidences, boxes = rng.integers(0, 256, shape), random_boxes(rng, frame, 2)
        camera = dataclasses.replace(frame.camera, slopes=slopes)
        frame = dataclasses.replace(with_confidences(frame, confidences), camera=camera, boxes=boxes)
        z = frame.depth_image * frame.depth_unit
        points = np.stack([slopes[0] * z.astype(np.float64), slopes[1] * z.astype(np.float64), z], axis=-1)
        same = CloudFrame("r", 0, points.reshape(-1, 3), frame.class_image.ravel(), frame.T_team_sensor, boxes=boxes)
        same = with_confidences(same, confidences.ravel())
        steps = clamped_increments(sensor)
        maps = [cells_of(sum_of_scans([each], steps, sensor=sensor, region=region)) for each in (frame, same)]
        assert maps[0] == maps[1]
        assert len(maps[0]) > 300


def test_slopes_of_a_pinhole_equal_the_pinhole():
    rng = np.random.default_rng(4)
    frame = random_depth(rng)
    camera = frame.camera
    v, u = np.mgrid[: camera.height, : camera.width]
    slopes = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy]).astype(np.float32)
    # With slopes, the intrinsics are not used.
    bent = dataclasses.replace(frame, camera=CameraModel(camera.width, camera.height, 1.0, 1.0, 0.0, 0.0, slopes))
    assert cells_of_scan(bent) == cells_of_scan(frame)


@pytest.mark.parametrize("rays", ["cells", "all"])
def test_memory_layout_of_confidences_and_slopes_does_not_change_the_result(rays):
    rng = np.random.default_rng(5)
    frame = random_depth(rng)
    shape = frame.depth_image.shape
    confidences, slopes = rng.integers(0, 256, shape).astype(np.uint8), _random_slopes(rng, shape)
    sensor = dataclasses.replace(SENSOR, rays=rays)

    def bent(layout):
        camera = dataclasses.replace(frame.camera, slopes=layout(slopes))
        return dataclasses.replace(frame, camera=camera, confidence_image=layout(confidences))

    expected = weighted_cells(bent(np.array), sensor)
    for layout in (np.asfortranarray, strided, lambda a: a[::-1][::-1], read_only_copy):
        assert weighted_cells(bent(layout), sensor) == expected
