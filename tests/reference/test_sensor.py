from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.records import BodyBox
from reference.hand_made import cloud, depth_frame, ray
from reference.sensor import measurements, scan_update

ONE_METRE = MapConfig(resolution=1.0)


def _touched(frame, sensor=None, region=ONE_METRE):
    update = scan_update(frame, sensor or SensorConfig(), region)
    hits = {tuple(key): int(c) for key, c in zip(update.hit.tolist(), update.hit_classes, strict=True)}
    return {tuple(key) for key in update.freed.tolist()}, hits


def test_a_ray_frees_the_cells_before_its_end_and_hits_the_end():
    assert _touched(ray("a", 0.0, 2)) == ({(0, 0, 0), (1, 0, 0)}, {(2, 0, 0): 2})


def test_pixels_project_through_the_pinhole_with_integer_pixel_centres():
    # Column 1, row 0 at depth 3: x_camera = 3 (right, team -y), so the point is (3.5, 0.5 - 3, 0.5).
    image = np.array([[0.0, 3.0]], dtype=np.float32)
    measured = measurements(depth_frame(image, [[1, 2]]), SensorConfig())
    assert measured.ends.tolist() == [[3.5, -2.5, 0.5]]
    assert measured.class_ids.tolist() == [2]
    assert measured.origin.tolist() == [0.5, 0.5, 0.5]


def test_depth_unit_scales_the_raw_value():
    image = np.array([[2000]], dtype=np.uint16)
    assert _touched(depth_frame(image, [[1]], unit=0.001))[1] == {(2, 0, 0): 1}


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -np.inf, -1.0])
def test_depths_that_are_not_positive_and_finite_carry_no_information(value):
    assert _touched(depth_frame(np.array([[value]], dtype=np.float32), [[1]])) == (set(), {})


@pytest.mark.parametrize("value", [0, 65535])
def test_zero_and_the_largest_integer_carry_no_information(value):
    frame = depth_frame(np.array([[value]], dtype=np.uint16), [[1]], unit=1e-4)
    assert _touched(frame) == (set(), {})


def test_invalid_depths_are_raw_values_in_the_dtype_of_the_image():
    frame = depth_frame(np.array([[2.1]], dtype=np.float32), [[1]])
    assert _touched(frame, SensorConfig(invalid_depth=(2.1,))) == (set(), {})
    assert _touched(frame, SensorConfig(invalid_depth=(2.2,)))[1] == {(2, 0, 0): 1}


@pytest.mark.parametrize(
    ("image", "meaning"),
    [(np.array([[0]], dtype=np.uint16), 0.0), (np.array([[np.nan]], dtype=np.float32), float("nan")),
     (np.array([[65535]], dtype=np.uint16), 65535.0), (np.array([[np.inf]], dtype=np.float32), float("inf"))],
)  # fmt: skip
def test_no_return_frees_up_to_the_cell_before_the_cut_end(image, meaning):
    sensor = SensorConfig(no_return_depth=(meaning,), invalid_depth=(meaning,), max_range=3.0)
    assert _touched(depth_frame(image, [[1]]), sensor) == ({(0, 0, 0), (1, 0, 0), (2, 0, 0)}, {})


def test_range_limits_apply_to_the_distance_of_the_measured_point():
    # Depth 2 at column 1: the point is 2 sqrt(2) = 2.83 m away.
    frame = depth_frame(np.array([[0.0, 2.0]], dtype=np.float32), [[0, 1]])
    assert _touched(frame, SensorConfig(min_range=2.9)) == (set(), {})
    assert _touched(frame, SensorConfig(min_range=2.8))[1] == {(2, -2, 0): 1}
    assert _touched(frame, SensorConfig(max_range=2.8))[1] == {}
    assert _touched(frame, SensorConfig(max_range=2.9))[1] == {(2, -2, 0): 1}


def test_range_limits_are_inclusive():
    frame = ray("a", 0.0, 1)
    assert _touched(frame, SensorConfig(min_range=2.0))[1] == {(2, 0, 0): 1}
    assert _touched(frame, SensorConfig(max_range=2.0))[1] == {(2, 0, 0): 1}


def test_a_cut_ray_frees_the_cells_before_the_cut_and_hits_nothing():
    assert _touched(ray("a", 0.0, 1, distance=7.0), SensorConfig(max_range=2.2)) == ({(0, 0, 0), (1, 0, 0)}, {})


def test_points_of_an_ignored_label_free_their_ray_and_hit_nothing():
    assert _touched(ray("a", 0.0, 0)) == ({(0, 0, 0), (1, 0, 0)}, {})


def test_an_image_without_labels_hits_class_one():
    assert _touched(depth_frame(np.array([[2.0]], dtype=np.float32)))[1] == {(2, 0, 0): 1}


def test_a_cell_that_is_hit_is_not_freed_by_another_ray_of_the_scan():
    freed, hit = _touched(cloud([[1, 0, 0], [3, 0, 0]], [1, 2]))
    assert hit == {(1, 0, 0): 1, (3, 0, 0): 2}
    assert freed == {(0, 0, 0), (2, 0, 0)}


def test_the_end_cell_of_an_ignored_point_is_freed_by_another_ray():
    freed, hit = _touched(cloud([[1, 0, 0], [3, 0, 0]], [0, 2]))
    assert (1, 0, 0) in freed
    assert hit == {(3, 0, 0): 2}


def test_the_origins_cell_is_freed_unless_it_is_hit():
    assert _touched(cloud([[0.1, 0, 0]], [1])) == (set(), {(0, 0, 0): 1})
    freed, hit = _touched(cloud([[0.1, 0, 0], [2, 0, 0]], [1, 1]))
    assert (freed, hit) == ({(1, 0, 0)}, {(0, 0, 0): 1, (2, 0, 0): 1})


def test_a_scan_without_a_usable_point_touches_nothing():
    assert _touched(cloud([[np.nan, 0, 0], [0, 0, np.inf], [0, 0, 0]], [1, 1, 1])) == (set(), {})


@pytest.mark.parametrize(
    ("class_ids", "winner"), [([2, 2, 1], 2), ([2, 1, 1], 1), ([3, 2, 2], 2), ([3, 2, 1], 1), ([0, 0, 3], 3)]
)
def test_majority_of_points_wins_and_ties_go_to_the_lower_id(class_ids, winner):
    points = [[2.0, 0.1 * i, 0] for i in range(len(class_ids))]
    assert _touched(cloud(points, class_ids))[1] == {(2, 0, 0): winner}


def test_cells_mode_casts_to_the_cells_centre_and_all_mode_to_the_point():
    # From (0.5, 0.5, 0.5) to (2.45, 1.05, 0.5): the y wall comes last; to the centre (2.5, 1.5) it is at t = 1/2.
    frame = cloud([[1.95, 0.55, 0]], [1])
    assert _touched(frame, SensorConfig(rays="cells"))[0] == {(0, 0, 0), (1, 0, 0), (1, 1, 0)}
    assert _touched(frame, SensorConfig(rays="all"))[0] == {(0, 0, 0), (1, 0, 0), (2, 0, 0)}


def test_cut_rays_go_to_the_centre_of_the_cell_of_their_cut_end_in_cells_mode_only():
    frame = cloud([[19.5, 5.5, 0]], [1])
    sensor = {rays: SensorConfig(rays=rays, max_range=2.0265) for rays in ("cells", "all")}
    assert _touched(frame, sensor["cells"]) == ({(0, 0, 0), (1, 0, 0), (1, 1, 0)}, {})
    assert _touched(frame, sensor["all"]) == ({(0, 0, 0), (1, 0, 0), (2, 0, 0)}, {})


def test_bounds_keep_cells_with_centres_inside():
    region = MapConfig(resolution=1.0, bounds=(0.6, -9.0, -9.0, 2.4, 9.0, 9.0))
    assert _touched(ray("a", 0.0, 1), region=region) == ({(1, 0, 0)}, {})
    band = MapConfig(resolution=1.0, bounds=(0.6, 9.0))
    assert _touched(ray("a", 0.0, 1), region=band) == (set(), {})


def _weighted(points, class_ids, confidences, **options):
    """(class, strength) of each hit cell of a cloud."""
    frame = dataclasses.replace(cloud(points, class_ids), confidences=np.array(confidences, np.uint8), **options)
    update = scan_update(frame, SensorConfig(), ONE_METRE)
    return list(zip(update.hit_classes.tolist(), update.hit_strengths.tolist(), strict=True))


@pytest.mark.parametrize(
    ("class_ids", "confidences", "winner"),
    [([2, 2, 1], [100, 100, 201], (1, 201)), ([2, 2, 1], [100, 101, 200], (2, 101)),
     ([2, 2, 1], [100, 101, 201], (1, 201)), ([3, 3, 3], [1, 1, 2], (3, 1)), ([3, 3, 3], [1, 2, 2], (3, 2)),
     ([3, 3, 1], [255, 0, 100], (3, 255)), ([0, 2, 2], [255, 1, 0], (2, 1))],
)  # fmt: skip
def test_largest_sum_of_confidences_wins_with_its_mean_as_strength(class_ids, confidences, winner):
    points = [[2.0, 0.1 * i, 0] for i in range(len(class_ids))]
    assert _weighted(points, class_ids, confidences) == [winner]


def test_hits_without_confidences_have_full_strength():
    assert scan_update(ray("a", 0.0, 2), SensorConfig(), ONE_METRE).hit_strengths.tolist() == [255]


def test_zero_confidence_frees_the_ray_only():
    assert _weighted([[2.0, 0, 0]], [1], [0]) == []
    frame = dataclasses.replace(ray("a", 0.0, 2), confidence_image=np.zeros((1, 1), np.uint8))
    assert _touched(frame) == ({(0, 0, 0), (1, 0, 0)}, {})


def _box(low, high, is_own):
    return BodyBox(np.array(low, float), np.array(high, float), np.eye(4), is_own)


def test_points_on_own_body_are_dropped_and_on_others_free_their_ray():
    free = {(0, 0, 0), (1, 0, 0)}
    # The point is at (2.5, 0.5, 0.5), in the corner of both boxes.
    own, other = _box([2.5, 0.5, 0.5], [3, 1, 1], is_own=True), _box([2, 0, 0], [2.5, 0.5, 0.5], is_own=False)
    for boxes, expected in (((own,), (set(), {})), ((other,), (free, {})), ((other, own), (set(), {}))):
        assert _touched(dataclasses.replace(ray("a", 0.0, 1), boxes=boxes)) == expected
    beside = _box([2.6, 0, 0], [3, 1, 1], is_own=True)
    assert _touched(dataclasses.replace(ray("a", 0.0, 1), boxes=(beside,))) == (free, {(2, 0, 0): 1})


def test_boxes_do_not_affect_cut_rays():
    boxes = (_box([-9, -9, -9], [9, 9, 9], is_own=True),)
    frame = dataclasses.replace(ray("a", 0.0, 1, distance=7.0), boxes=boxes)
    assert _touched(frame, SensorConfig(max_range=2.2)) == ({(0, 0, 0), (1, 0, 0)}, {})


def test_slopes_replace_the_pinhole():
    frame = ray("a", 0.0, 1)
    camera = dataclasses.replace(frame.camera, slopes=np.array([[[0.5]], [[-1.0]]], np.float32))
    # Depth 2: 1 m to the right, 2 m up.
    assert measurements(dataclasses.replace(frame, camera=camera), SensorConfig()).ends.tolist() == [[2.5, -0.5, 2.5]]
    camera.slopes[0] = np.nan
    for sensor in (SensorConfig(), SensorConfig(no_return_depth=(2.0,))):
        assert _touched(dataclasses.replace(frame, camera=camera), sensor) == (set(), {})


def test_float32_clouds_are_used_in_float64():
    measured = measurements(cloud([[0.1, 0, 0]], [1], dtype=np.float32), SensorConfig())
    assert measured.ends[0, 0] == np.float64(np.float32(0.1)) + 0.5
