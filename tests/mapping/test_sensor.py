"""Cells that a scan touches, against the reference."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.mapping.kernels import storage
from octoreplay.records import CloudFrame, DepthFrame
from reference.hand_made import cloud, depth_frame, facing_x
from support.long_suite import examples, long, one_in
from support.scans import SENSOR, cells_of_scan, check_scan, random_cloud, random_depth

# --- against the reference -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("seed", "rays"), one_in(3, range(12), ["cells", "all"]))
def test_random_scans(seed, rays):
    rng = np.random.default_rng(seed)
    sensor = dataclasses.replace(SENSOR, rays=rays, min_range=0.4)
    region = MapConfig(resolution=(0.2, 0.13, 0.25, 0.5)[seed % 4])
    for frame in (
        random_depth(rng), random_depth(rng, np.uint16), random_cloud(rng), random_cloud(rng, np.float64),
    ):  # fmt: skip
        freed, hit = check_scan(frame, sensor, region)
        assert freed
        assert hit


@pytest.mark.parametrize(
    "bounds", [(-0.5, 0.6), (-1.0, -1.1, -0.7, 1.3, 0.9, 1.1), (0.2, 0.4), (-0.3, 0.7), (5.0, 9.0)]
)
def test_random_scans_in_a_region(bounds):
    rng = np.random.default_rng(3)
    for _ in range(4):
        for rays in ("cells", "all"):
            frame, sensor = random_depth(rng), dataclasses.replace(SENSOR, rays=rays)
            check_scan(frame, sensor, MapConfig(resolution=0.2, bounds=bounds))


@pytest.mark.parametrize(("resolution", "low", "high"), [(0.7, 89.25, 91.35), (0.3, -0.45, 0.15), (0.2, 0.5, 0.7)])
def test_bounds_through_cell_centres(resolution, low, high):
    pose = np.eye(4)
    pose[:3, 3] = (0.01, 0.02, low - 3 * resolution)
    frame = CloudFrame("r", 0, np.array([[0.0, 0.0, 10 * resolution]]), None, pose)
    freed, _ = check_scan(frame, dataclasses.replace(SENSOR, max_range=50.0), MapConfig(resolution, bounds=(low, high)))
    assert freed


@examples(60)
@given(
    origin=st.tuples(*[st.integers(-24, 24)] * 3),
    ends=st.lists(st.tuples(*[st.integers(-30, 30)] * 3), min_size=1, max_size=6),
    rays=st.sampled_from(["cells", "all"]),
)
def test_origins_and_points_on_borders_edges_and_corners(origin, ends, rays):
    """Coordinates are multiples of 1/8 and cells of 1/4 m: rays cross walls exactly, several at once."""
    pose = np.eye(4)
    pose[:3, 3] = np.array(origin) / 8
    frame = CloudFrame("r", 0, np.array(ends) / 8, None, pose)
    check_scan(frame, dataclasses.replace(SENSOR, rays=rays, max_range=100.0), MapConfig(resolution=0.25))


@long
@pytest.mark.parametrize("resolution", one_in(3, [0.1, 0.2, 0.3]))
def test_walls_at_decimal_places(resolution):
    """Origins at centres and on walls of cells with an edge that is no binary fraction; rays to cell centres."""
    places = [k * resolution / 2 for k in range(-5, 6)]
    ends = np.array(list(itertools.product((-1.7, -0.35, 0.0, 0.25, 1.5), repeat=3)))
    for origin in itertools.product(places[::2], places[1::3], places[::5]):
        pose = np.eye(4)
        pose[:3, 3] = origin
        check_scan(CloudFrame("r", 0, ends, None, pose), SENSOR, MapConfig(resolution=resolution))


@pytest.mark.parametrize(("seed", "rays"), one_in(3, range(4), ["cells", "all"]))
def test_long_rays(seed, rays):
    """Rays of hundreds of cells are traversed in several pieces; some end next to the end of a piece."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(60, 3))
    directions[:6] = [[1, 0, 0], [0, -1, 0], [0, 0, 1], [1, 1, 0], [-1, 1, 1], [0.5, -1, 0.25]]
    near_pieces = 64 * rng.integers(1, 6, 20) + rng.integers(-2, 3, 20)
    lengths = np.concatenate([rng.uniform(1.0, 40.0, 40), near_pieces * 0.1])
    points = directions / np.abs(directions).max(axis=1, keepdims=True) * lengths[:, None]
    pose = np.eye(4)
    pose[:3, 3] = rng.uniform(-20, 20, 3)
    frame = CloudFrame("r", 0, points, rng.integers(0, 3, 60).astype(np.uint8), pose)
    freed, _ = check_scan(frame, dataclasses.replace(SENSOR, rays=rays, max_range=35.0), MapConfig(resolution=0.1))
    assert len(freed) > 5000


@examples(80)
@given(
    origin=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    point=st.tuples(*[st.floats(-30.0, 30.0).map(lambda value: round(value, 6))] * 3),
    resolution=st.sampled_from([0.1, 0.25, 0.3]),
    rays=st.sampled_from(["cells", "all"]),
)
def test_ray_is_a_path_of_face_neighbours(origin, point, resolution, rays):
    """No cell is skipped or passed twice, and the end cell is not freed: one cell for each wall crossed."""
    pose = np.eye(4)
    pose[:3, 3] = origin
    frame = CloudFrame("r", 0, np.array([point]), None, pose)
    sensor = dataclasses.replace(SENSOR, rays=rays, max_range=100.0)
    freed, hit = cells_of_scan(frame, sensor, MapConfig(resolution=resolution))
    if not np.any(point):
        assert not freed
        return
    (end,) = hit
    start = tuple(np.floor(np.array(origin) / resolution).astype(int).tolist())
    assert len(freed) == sum(abs(e - s) for e, s in zip(end, start, strict=True))
    at, rest = start, set(freed)
    while rest:
        rest.remove(at)
        steps = [tuple(k + d * (axis == a) for a, k in enumerate(at)) for axis in range(3) for d in (-1, 1)]
        following = [step for step in steps if step in rest or (step == end and not rest)]
        assert len(following) == 1
        (at,) = following
    assert at == end


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("rays", ["cells", "all"])
def test_rays_along_an_axis(axis, sign, rays):
    point = np.zeros(3)
    point[axis] = 2.0 * sign
    sensor = dataclasses.replace(SENSOR, rays=rays)
    freed, hit = check_scan(cloud([point], [3]), sensor, MapConfig(resolution=0.25))
    end = [2, 2, 2]
    end[axis] += 8 if sign > 0 else -8
    assert hit == {tuple(end): 3}
    assert len(freed) == 8


def test_negative_coordinates_by_hand():
    frame = depth_frame(np.array([[1.0]], np.float32), [[2]], pose=facing_x(-3.1, -0.5, -2.5))
    freed, hit = check_scan(frame, SENSOR, MapConfig(resolution=1.0))
    assert freed == {(-4, -1, -3)}
    assert hit == {(-3, -1, -3): 2}


@pytest.mark.parametrize("distance", [3.9, np.nextafter(4.0, 0), 4.0, np.nextafter(4.0, 9), 4.1])
def test_point_at_exactly_max_range_is_a_hit(distance):
    for frame in (
        depth_frame(np.array([[distance]], np.float32), [[2]]), cloud([[distance, 0, 0]], [2]),
    ):  # fmt: skip
        freed, hit = check_scan(frame, SENSOR, MapConfig(resolution=1.0))
        within = float(np.float32(distance) if isinstance(frame, DepthFrame) else distance) <= 4.0
        assert hit == ({(int(distance + 0.5), 0, 0): 2} if within else {})
        assert len(freed) == int(min(distance, 4.0) + 0.5)


def test_point_at_exactly_min_range_is_used():
    sensor = dataclasses.replace(SENSOR, min_range=2.0)
    for distance, used in ((2.0, True), (np.nextafter(np.float32(2.0), np.float32(0)), False)):
        for frame in (depth_frame(np.array([[distance]], np.float32), [[2]]), cloud([[distance, 0, 0]], [2])):
            assert bool(check_scan(frame, sensor, MapConfig(resolution=1.0))[0]) == used


def test_scan_in_the_cell_of_the_origin():
    assert check_scan(cloud([[0.01, 0.0, 0.0]], [1])) == (set(), {(2, 2, 2): 1})
    assert check_scan(cloud([[0.01, 0.0, 0.0]], [0])) == (set(), {})
    freed, hit = check_scan(cloud([[0.01, 0.0, 0.0], [1.0, 0.0, 0.0]], [1, 2]))
    assert (2, 2, 2) in hit
    assert (2, 2, 2) not in freed


def test_majority_of_points_wins_and_ties_go_to_the_lower_id():
    near = np.array([[2.0, 0.0, 0.0]]) + np.arange(6)[:, None] * 1e-3
    assert set(check_scan(cloud(near, [4, 2, 2, 4, 4, 0]))[1].values()) == {4}
    assert set(check_scan(cloud(near, [4, 2, 2, 4, 0, 0]))[1].values()) == {2}
    assert check_scan(cloud(near, [0] * 6))[1] == {}


def test_scans_without_points():
    assert check_scan(cloud(np.zeros((0, 3)), [])) == (set(), {})
    assert check_scan(cloud([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0]], [1, 1, 1])) == (set(), {})
    assert check_scan(depth_frame(np.zeros((3, 4), np.uint16), unit=0.001)) == (set(), {})
    assert check_scan(depth_frame(np.zeros((0, 0), np.float32))) == (set(), {})


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_values_without_information(dtype):
    values = [0, 1, 2, 3, 7, 8]
    values += [np.nan, np.inf, -np.inf, -1.0, 2.1] if dtype == np.float32 else [np.iinfo(dtype).max]
    image = np.array([values], dtype)
    options = [{}, {"invalid_depth": (7.0, 2.1)}, {"no_return_depth": (0.0, 3.0)}, {"invalid_depth": (3.0,)}]
    options += [{"invalid_depth": (3.0, np.nan), "no_return_depth": (3.0, 2.1)}]
    options += [{"no_return_depth": (float(np.iinfo(dtype).max),)}] if dtype != np.float32 else []
    options += [{"no_return_depth": (np.nan, np.inf, -1.0)}, {"no_return_depth": (2.1, np.nan), "min_range": 1.5}]
    for option in options:
        check_scan(depth_frame(image), dataclasses.replace(SENSOR, max_range=7.5, **option), MapConfig(resolution=0.5))


# --- the edge of the key space ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1, 1])
def test_scans_that_leave_the_key_space_are_refused(axis, sign):
    region = MapConfig(resolution=0.25)
    reach = storage.KEY_OFFSET * 0.25
    pose = np.eye(4)
    pose[axis, 3] = sign * (reach - 3.1)
    point = np.zeros(3)
    point[axis] = sign * 1.0
    inside = CloudFrame("r", 0, np.array([point]), None, pose)
    freed, hit = check_scan(inside, SENSOR, region)
    assert len(freed) == 4
    assert len(hit) == 1
    far = CloudFrame("robot_7", 5, np.array([point * 3.5]), None, pose)
    with pytest.raises(
        InputError, match=r"robot 'robot_7', 5 ns: the scan lies outside the map, which reaches 65536 m"
    ):
        cells_of_scan(far, SENSOR, region)
    pose = pose.copy()
    pose[axis, 3] = sign * (reach + 1.0)
    for origin in (pose, np.full((4, 4), np.nan), pose * 1e30):
        with pytest.raises(InputError, match="outside the map"):
            cells_of_scan(CloudFrame("r", 0, np.array([-2.0 * point]), None, origin), SENSOR, region)
        with pytest.raises(InputError, match="outside the map"):
            cells_of_scan(CloudFrame("r", 0, np.zeros((0, 3)), None, origin), SENSOR, region)


def test_resolution_too_fine_for_the_range_is_refused():
    frame = cloud([[100.0, 100.0, 100.0]], [1])
    with pytest.raises(ConfigError, match=r"resolution: 0.01 m is too fine for max_range 500 m"):
        cells_of_scan(frame, SensorConfig(max_range=500.0), MapConfig(resolution=0.01))
