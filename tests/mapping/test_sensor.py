from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.mapping.kernels import ends, storage
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import (
    COUNT_SCANS,
    ScanCaster,
    add_scan,
    clamped_increments,
    unclamped_increments,
)
from octoreplay.records import BodyBox, CameraModel, CloudFrame, DepthFrame
from reference.evidence import Evidence, IndexedScan
from reference.hand_made import FACING_X, cloud, depth_frame, facing_x
from reference.scenarios import TeamShape, make_scenario
from reference.sensor import scan_update
from support.octree_factory import cells_of

NUM_CLASSES = 5
SENSOR = SensorConfig(max_range=4.0)
MAP = MapConfig(resolution=0.2)


def _cells(frame, sensor=SENSOR, region=MAP, num_classes=NUM_CLASSES, caster=None):
    """(freed keys, {hit key: class_id}) of a scan, from the caster."""
    freed, hit = _weighted_cells(frame, sensor, region, num_classes, caster)
    return freed, {key: class_id for key, (class_id, _) in hit.items()}


def _weighted_cells(frame, sensor=SENSOR, region=MAP, num_classes=NUM_CLASSES, caster=None):
    """(freed keys, {hit key: (class_id, strength)}) of a scan, from the caster."""
    touched = (caster or ScanCaster(sensor, region, num_classes)).cast(frame)
    assert len(set(touched.codes.tolist())) == len(touched.codes)
    marks = touched.marks.reshape(-1, storage.BRICK_CELLS)[touched.touched]
    rows, cells = np.nonzero(marks)
    keys = np.empty((len(rows), 3), np.int64)
    storage.codes_to_keys((touched.codes[rows] << storage.CELL_BITS) + cells, keys)
    kinds = marks[rows, cells].tolist()
    strengths = np.full(len(kinds), 255)
    if touched.strengths.size:
        strengths = touched.strengths.reshape(-1, storage.BRICK_CELLS)[touched.touched][rows, cells]
    content = dict(zip(map(tuple, keys.tolist()), zip(kinds, strengths.tolist(), strict=True), strict=True))
    freed = {key for key, (kind, _) in content.items() if kind == 1}
    return freed, {key: (kind - 1, strength) for key, (kind, strength) in content.items() if kind > 1}


def _expected(frame, sensor=SENSOR, region=MAP):
    freed, hit = _weighted_expected(frame, sensor, region)
    return freed, {key: class_id for key, (class_id, _) in hit.items()}


def _weighted_expected(frame, sensor=SENSOR, region=MAP):
    update = scan_update(frame, sensor, region)
    winners = zip(update.hit_classes.tolist(), update.hit_strengths.tolist(), strict=True)
    freed = {tuple(key) for key in update.freed.tolist()}
    return freed, dict(zip(map(tuple, update.hit.tolist()), winners, strict=True))


def _agree(frame, sensor=SENSOR, region=MAP, num_classes=NUM_CLASSES):
    freed, hit = _weighted_cells(frame, sensor, region, num_classes)
    expected_freed, expected_hit = _weighted_expected(frame, sensor, region)
    assert hit == expected_hit
    assert freed - expected_freed == set()
    assert expected_freed - freed == set()
    return freed, {key: class_id for key, (class_id, _) in hit.items()}


def _random_pose(rng, spread=3.0):
    """A pose with a random rotation near the origin."""
    x, y, z, w = (q := rng.normal(size=4)) / np.linalg.norm(q)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = rng.uniform(-spread, spread, 3)
    return pose


def _random_depth(rng, dtype=np.float32, size=(11, 14)):
    depth = rng.uniform(0.0, 6.0, size)
    image = depth.astype(np.float32) if dtype == np.float32 else (depth * 1000).astype(np.uint16)
    classes = rng.integers(0, NUM_CLASSES + 1, size).astype(np.uint8)
    camera = CameraModel(size[1], size[0], 9.0, 8.5, 6.3, 5.2)
    return DepthFrame("r", 0, image, 1.0 if dtype == np.float32 else 0.001, classes, camera, _random_pose(rng))


def _random_cloud(rng, dtype=np.float32, size=150):
    points = (rng.normal(size=(size, 3)) * 2.5).astype(dtype)
    points[rng.random(size) < 0.1] = np.nan
    classes = rng.integers(0, NUM_CLASSES + 1, size).astype(np.uint8)
    return CloudFrame("r", 0, points, classes, _random_pose(rng))


# --- against the reference -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rays", ["cells", "all"])
@pytest.mark.parametrize("seed", range(12))
def test_random_scans(seed, rays):
    rng = np.random.default_rng(seed)
    sensor = dataclasses.replace(SENSOR, rays=rays, min_range=0.4)
    region = MapConfig(resolution=(0.2, 0.13, 0.25, 0.5)[seed % 4])
    for frame in (
        _random_depth(rng), _random_depth(rng, np.uint16), _random_cloud(rng), _random_cloud(rng, np.float64),
    ):  # fmt: skip
        freed, hit = _agree(frame, sensor, region)
        assert freed
        assert hit


@pytest.mark.parametrize(
    "bounds", [(-0.5, 0.6), (-1.0, -1.1, -0.7, 1.3, 0.9, 1.1), (0.2, 0.4), (-0.3, 0.7), (5.0, 9.0)]
)
def test_random_scans_in_a_region(bounds):
    rng = np.random.default_rng(3)
    for _ in range(4):
        for rays in ("cells", "all"):
            frame, sensor = _random_depth(rng), dataclasses.replace(SENSOR, rays=rays)
            _agree(frame, sensor, MapConfig(resolution=0.2, bounds=bounds))


@pytest.mark.parametrize(("resolution", "low", "high"), [(0.7, 89.25, 91.35), (0.3, -0.45, 0.15), (0.2, 0.5, 0.7)])
def test_bounds_through_cell_centres(resolution, low, high):
    pose = np.eye(4)
    pose[:3, 3] = (0.01, 0.02, low - 3 * resolution)
    frame = CloudFrame("r", 0, np.array([[0.0, 0.0, 10 * resolution]]), None, pose)
    freed, _ = _agree(frame, dataclasses.replace(SENSOR, max_range=50.0), MapConfig(resolution, bounds=(low, high)))
    assert freed


@settings(max_examples=60, deadline=None)
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
    _agree(frame, dataclasses.replace(SENSOR, rays=rays, max_range=100.0), MapConfig(resolution=0.25))


@pytest.mark.parametrize("resolution", [0.1, 0.2, 0.3])
def test_walls_at_decimal_places(resolution):
    """Origins at centres and on walls of cells with an edge that is no binary fraction; rays to cell centres."""
    places = [k * resolution / 2 for k in range(-5, 6)]
    ends = np.array(list(itertools.product((-1.7, -0.35, 0.0, 0.25, 1.5), repeat=3)))
    for origin in itertools.product(places[::2], places[1::3], places[::5]):
        pose = np.eye(4)
        pose[:3, 3] = origin
        _agree(CloudFrame("r", 0, ends, None, pose), SENSOR, MapConfig(resolution=resolution))


@pytest.mark.parametrize("rays", ["cells", "all"])
@pytest.mark.parametrize("seed", range(4))
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
    freed, _ = _agree(frame, dataclasses.replace(SENSOR, rays=rays, max_range=35.0), MapConfig(resolution=0.1))
    assert len(freed) > 5000


@settings(max_examples=80, deadline=None)
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
    freed, hit = _cells(frame, sensor, MapConfig(resolution=resolution))
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
    freed, hit = _agree(cloud([point], [3]), sensor, MapConfig(resolution=0.25))
    end = [2, 2, 2]
    end[axis] += 8 if sign > 0 else -8
    assert hit == {tuple(end): 3}
    assert len(freed) == 8


def test_negative_coordinates_by_hand():
    frame = depth_frame(np.array([[1.0]], np.float32), [[2]], pose=facing_x(-3.1, -0.5, -2.5))
    freed, hit = _agree(frame, SENSOR, MapConfig(resolution=1.0))
    assert freed == {(-4, -1, -3)}
    assert hit == {(-3, -1, -3): 2}


@pytest.mark.parametrize("distance", [3.9, np.nextafter(4.0, 0), 4.0, np.nextafter(4.0, 9), 4.1])
def test_point_at_exactly_max_range_is_a_hit(distance):
    for frame in (
        depth_frame(np.array([[distance]], np.float32), [[2]]), cloud([[distance, 0, 0]], [2]),
    ):  # fmt: skip
        freed, hit = _agree(frame, SENSOR, MapConfig(resolution=1.0))
        within = float(np.float32(distance) if isinstance(frame, DepthFrame) else distance) <= 4.0
        assert hit == ({(int(distance + 0.5), 0, 0): 2} if within else {})
        assert len(freed) == int(min(distance, 4.0) + 0.5)


def test_point_at_exactly_min_range_is_used():
    sensor = dataclasses.replace(SENSOR, min_range=2.0)
    for distance, used in ((2.0, True), (np.nextafter(np.float32(2.0), np.float32(0)), False)):
        for frame in (depth_frame(np.array([[distance]], np.float32), [[2]]), cloud([[distance, 0, 0]], [2])):
            assert bool(_agree(frame, sensor, MapConfig(resolution=1.0))[0]) == used


def test_scan_in_the_cell_of_the_origin():
    assert _agree(cloud([[0.01, 0.0, 0.0]], [1])) == (set(), {(2, 2, 2): 1})
    assert _agree(cloud([[0.01, 0.0, 0.0]], [0])) == (set(), {})
    freed, hit = _agree(cloud([[0.01, 0.0, 0.0], [1.0, 0.0, 0.0]], [1, 2]))
    assert (2, 2, 2) in hit
    assert (2, 2, 2) not in freed


def test_majority_of_points_wins_and_ties_go_to_the_lower_id():
    near = np.array([[2.0, 0.0, 0.0]]) + np.arange(6)[:, None] * 1e-3
    assert set(_agree(cloud(near, [4, 2, 2, 4, 4, 0]))[1].values()) == {4}
    assert set(_agree(cloud(near, [4, 2, 2, 4, 0, 0]))[1].values()) == {2}
    assert _agree(cloud(near, [0] * 6))[1] == {}


def test_scans_without_points():
    assert _agree(cloud(np.zeros((0, 3)), [])) == (set(), {})
    assert _agree(cloud([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0]], [1, 1, 1])) == (set(), {})
    assert _agree(depth_frame(np.zeros((3, 4), np.uint16), unit=0.001)) == (set(), {})
    assert _agree(depth_frame(np.zeros((0, 0), np.float32))) == (set(), {})


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
        _agree(depth_frame(image), dataclasses.replace(SENSOR, max_range=7.5, **option), MapConfig(resolution=0.5))


# --- layouts of the input --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_memory_layout_of_images_does_not_change_the_result(dtype):
    frame = _random_depth(np.random.default_rng(1), dtype)
    expected = _cells(frame)
    for layout in (np.asfortranarray, _strided, lambda a: a[::-1][::-1], lambda a: _read_only(a)):
        other = dataclasses.replace(
            frame, depth_image=layout(frame.depth_image), class_image=layout(frame.class_image),
            T_team_sensor=np.asfortranarray(frame.T_team_sensor),
        )  # fmt: skip
        assert _cells(other) == expected
    big_endian = dataclasses.replace(
        frame, depth_image=frame.depth_image.astype(frame.depth_image.dtype.newbyteorder(">"))
    )
    assert _cells(big_endian) == expected
    assert _cells(dataclasses.replace(frame, T_team_sensor=frame.T_team_sensor.astype(np.float32))) == _cells(
        dataclasses.replace(frame, T_team_sensor=frame.T_team_sensor.astype(np.float32).astype(np.float64))
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_memory_layout_of_clouds_does_not_change_the_result(dtype):
    frame = _random_cloud(np.random.default_rng(2), dtype)
    expected = _cells(frame)
    for layout in (np.asfortranarray, _strided, lambda a: a[::-1][::-1], _read_only):
        other = dataclasses.replace(frame, points=layout(frame.points), class_ids=layout(frame.class_ids))
        assert _cells(other) == expected
    swapped = dataclasses.replace(frame, points=frame.points.astype(frame.points.dtype.newbyteorder(">")))
    assert _cells(swapped) == expected


def _strided(array):
    """The same values with gaps in memory."""
    wide = np.zeros(tuple(2 * n for n in array.shape), array.dtype)
    view = wide[tuple(slice(None, None, 2) for _ in array.shape)]
    view[...] = array
    return view


def _read_only(array):
    copy = array.copy()
    copy.setflags(write=False)
    return copy


def test_reused_caster_equals_a_new_one():
    """Its scratch grid grows, shrinks and moves; no marks of an earlier scan may remain."""
    scenario = make_scenario(3, TeamShape(num_robots=2, num_ticks=12, image=(12, 9), sensors="mixed"))
    caster = ScanCaster(SENSOR, MAP, NUM_CLASSES)
    rng = np.random.default_rng(0)
    for frame in scenario.frames:
        moved = dataclasses.replace(frame, T_team_sensor=_random_pose(rng, spread=50.0))
        assert _cells(moved, caster=caster) == _cells(moved)


# --- confidences, bodies, lenses -------------------------------------------------------------------------------------


def _with_confidences(frame, confidences):
    name = "confidence_image" if isinstance(frame, DepthFrame) else "confidences"
    return dataclasses.replace(frame, **{name: np.asarray(confidences, np.uint8)})


def _random_boxes(rng, frame, count):
    """Boxes of any rotation within the range of the scan; some contain the sensor."""
    boxes = []
    for _ in range(count):
        low = rng.uniform(-3.0, 0.2, 3)
        turned = _random_pose(rng)
        turned[:3, 3] -= turned[:3, :3] @ frame.T_team_sensor[:3, 3]
        boxes.append(BodyBox(low, low + rng.uniform(0.2, 4.0, 3), turned, bool(rng.random() < 0.5)))
    return tuple(boxes)


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
        frame = _random_cloud(rng, rng.choice([np.float32, np.float64]), size=int(rng.choice([300, 1300])))
    else:
        frame = _random_depth(rng, np.float32 if kind == "depth32" else np.uint16)
        frame.depth_image[rng.random(frame.depth_image.shape) < 0.05] = 7
    labels = "class_ids" if kind == "cloud" else "class_image"
    shape = getattr(frame, labels).shape
    frame = dataclasses.replace(frame, **{labels: rng.integers(0, num_classes + 1, shape).astype(np.uint8)})
    if bent and kind != "cloud":
        camera = dataclasses.replace(frame.camera, slopes=_random_slopes(rng, shape))
        frame = dataclasses.replace(frame, camera=camera)
    if confident:
        few = rng.random() < 0.5
        frame = _with_confidences(frame, rng.choice([0, 1, 2, 127, 128, 255] if few else np.arange(256), shape))
    return dataclasses.replace(frame, boxes=_random_boxes(rng, frame, num_boxes))


@settings(max_examples=120, deadline=None)
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
    _agree(frame, sensor, MapConfig(resolution), num_classes)


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
        frame = _with_confidences(cloud(near, class_ids), confidences)
        assert list(_weighted_cells(frame)[1].values()) == [winner]
        _agree(frame)


@pytest.mark.parametrize("rays", ["cells", "all"])
def test_points_with_zero_confidence_free_their_ray_and_hit_nothing(rays):
    sensor = dataclasses.replace(SENSOR, rays=rays)
    for frame in (cloud([[2.0, 0, 0]], [1]), cloud([[2.0, 0, 0]], None), depth_frame(np.array([[2.0]], np.float32))):
        shape = (1,) if isinstance(frame, CloudFrame) else (1, 1)
        freed, hit = _agree(_with_confidences(frame, np.zeros(shape)), sensor, MapConfig(0.25))
        assert len(freed) == 8
        assert not hit


def test_sums_of_confidences_beyond_int32():
    """Sums of two classes in one cell exceed 2^31 and differ by 1."""
    lengths = np.full(4, 8_000_000, np.int32)
    sums = 255 * lengths
    lengths[3], sums[3] = lengths[3] + 1, sums[3] + 1
    keys, kinds = np.zeros((4, 3), np.int32), np.array([1, 2, 1, 2], np.uint8)
    low, edges, table = np.zeros(3, np.int64), np.ones(3, np.int64), np.full(8, -1, np.int32)
    votes, end_cells = np.zeros((1, 2), np.int32), np.zeros(1, np.int64)
    end_keys, marks, strengths = np.zeros((1, 3), np.int32), np.zeros(1, np.uint8), np.zeros(1, np.uint8)
    ends.distinct_ends(keys, kinds, lengths, low, edges, 2, table, votes, end_cells, end_keys, marks)
    vote_sums = np.zeros((1, 2), np.int64)
    ends.weigh_ends(keys, kinds, sums, low, edges, 2, table, votes, vote_sums, end_cells, marks, strengths)
    assert (marks[0], strengths[0]) == (3, 255)
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
            freed, hit = _agree(dataclasses.replace(frame, boxes=boxes), sensor, MapConfig(0.25))
            assert (len(freed), len(hit)) == (num_freed, num_hits)


@pytest.mark.parametrize("is_own", [True, False])
def test_boxes_do_not_affect_cut_rays(is_own):
    everywhere = _box([-99] * 3, [99] * 3, is_own=is_own)
    for frame in (cloud([[9.0, 0, 0]], [1]), depth_frame(np.array([[9.0]], np.float32))):
        freed, hit = _agree(dataclasses.replace(frame, boxes=(everywhere,)), SENSOR, MapConfig(0.25))
        assert (len(freed), hit) == (16, {})


def test_boxes_are_transformed_to_their_frame():
    T_box_team = np.linalg.inv(facing_x(2.5, 0.5, 0.5))
    # The box is 1/8 m thick along its frame's z, which is the team's x.
    ahead = _box([0, 0, 0], [0, 0, 0.125], is_own=True, pose=T_box_team)
    points = [[2.0, 0, 0], [2.125, 0, 0], [2.0, 0.125, 0], [2.0, 0, 0.125]]
    hits = [_agree(dataclasses.replace(cloud([point], [1]), boxes=(ahead,)))[1] for point in points]
    assert [len(hit) for hit in hits] == [0, 0, 1, 1]


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
@pytest.mark.parametrize("rays", ["cells", "all"])
def test_image_with_distortion_equals_the_cloud_of_its_points(dtype, rays):
    """The maps are equal bit for bit, with boxes and confidences."""
    sensor, region = dataclasses.replace(SENSOR, rays=rays), MapConfig(0.3)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        frame = _random_depth(rng, dtype)
        shape = frame.depth_image.shape
        slopes = _random_slopes(rng, shape)
        confidences, boxes = rng.integers(0, 256, shape), _random_boxes(rng, frame, 2)
        camera = dataclasses.replace(frame.camera, slopes=slopes)
        frame = dataclasses.replace(_with_confidences(frame, confidences), camera=camera, boxes=boxes)
        z = frame.depth_image * frame.depth_unit
        points = np.stack([slopes[0] * z.astype(np.float64), slopes[1] * z.astype(np.float64), z], axis=-1)
        same = CloudFrame("r", 0, points.reshape(-1, 3), frame.class_image.ravel(), frame.T_team_sensor, boxes=boxes)
        same = _with_confidences(same, confidences.ravel())
        steps = clamped_increments(sensor)
        maps = [cells_of(_sums([each], steps, sensor=sensor, region=region)) for each in (frame, same)]
        assert maps[0] == maps[1]
        assert len(maps[0]) > 300


def test_slopes_of_a_pinhole_equal_the_pinhole():
    rng = np.random.default_rng(4)
    frame = _random_depth(rng)
    camera = frame.camera
    v, u = np.mgrid[: camera.height, : camera.width]
    slopes = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy]).astype(np.float32)
    # With slopes, the intrinsics are not used.
    bent = dataclasses.replace(frame, camera=CameraModel(camera.width, camera.height, 1.0, 1.0, 0.0, 0.0, slopes))
    assert _cells(bent) == _cells(frame)


@pytest.mark.parametrize("rays", ["cells", "all"])
def test_memory_layout_of_confidences_and_slopes_does_not_change_the_result(rays):
    rng = np.random.default_rng(5)
    frame = _random_depth(rng)
    shape = frame.depth_image.shape
    confidences, slopes = rng.integers(0, 256, shape).astype(np.uint8), _random_slopes(rng, shape)
    sensor = dataclasses.replace(SENSOR, rays=rays)

    def bent(layout):
        camera = dataclasses.replace(frame.camera, slopes=layout(slopes))
        return dataclasses.replace(frame, camera=camera, confidence_image=layout(confidences))

    expected = _weighted_cells(bent(np.array), sensor)
    for layout in (np.asfortranarray, _strided, lambda a: a[::-1][::-1], _read_only):
        assert _weighted_cells(bent(layout), sensor) == expected


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
    freed, hit = _agree(inside, SENSOR, region)
    assert len(freed) == 4
    assert len(hit) == 1
    far = CloudFrame("robot_7", 5, np.array([point * 3.5]), None, pose)
    with pytest.raises(
        InputError, match=r"robot 'robot_7', 5 ns: the scan lies outside the map, which reaches 65536 m"
    ):
        _cells(far, SENSOR, region)
    pose = pose.copy()
    pose[axis, 3] = sign * (reach + 1.0)
    for origin in (pose, np.full((4, 4), np.nan), pose * 1e30):
        with pytest.raises(InputError, match="outside the map"):
            _cells(CloudFrame("r", 0, np.array([-2.0 * point]), None, origin), SENSOR, region)
        with pytest.raises(InputError, match="outside the map"):
            _cells(CloudFrame("r", 0, np.zeros((0, 3)), None, origin), SENSOR, region)


def test_resolution_too_fine_for_the_range_is_refused():
    frame = cloud([[100.0, 100.0, 100.0]], [1])
    with pytest.raises(ConfigError, match=r"resolution: 0.01 m is too fine for max_range 500 m"):
        _cells(frame, SensorConfig(max_range=500.0), MapConfig(resolution=0.01))


# --- sums ------------------------------------------------------------------------------------------------------------


def _sums(frames, increments, num_classes=NUM_CLASSES, sensor=SENSOR, region=MAP):
    octree = SemanticOctree(region.resolution, num_classes)
    caster = ScanCaster(sensor, region, NUM_CLASSES)
    for revision, frame in enumerate(frames):
        add_scan(octree, caster.cast(frame), increments, revision)
    return octree


@pytest.mark.parametrize("increments", ["clamped", "unclamped", "count"])
def test_sums_of_many_scans_equal_the_reference(increments):
    sensor = SensorConfig(max_range=4.0, hit=0.75, miss=-0.5, hit_other=-0.25, clamp_min=-2.0, clamp_max=1.5)
    steps = {
        "clamped": clamped_increments(sensor), "unclamped": unclamped_increments(sensor), "count": COUNT_SCANS,
    }[increments]  # fmt: skip
    num_classes = 1 if increments == "count" else NUM_CLASSES
    scenario = make_scenario(2, TeamShape(num_robots=2, num_ticks=15, image=(12, 9), resolution=0.4, sensors="mixed"))
    region = MapConfig(resolution=0.4)
    octree = _sums(scenario.frames, steps, num_classes, sensor, region)
    expected = {}
    for frame in scenario.frames:
        freed, hit = _expected(frame, sensor, region)
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
        frames.append(frame if given is None else _with_confidences(frame, given))
    return frames


def test_full_confidence_equals_no_confidences():
    """Bit for bit, in evidence and in counts."""
    sensor, region = SensorConfig(max_range=4.0, hit=0.85, miss=-0.41, hit_other=-0.13), MapConfig(0.4)
    plain, sure = _mixed_scenario(lambda _: None), _mixed_scenario(lambda shape: np.full(shape, 255))
    for num_classes, steps in (
        (NUM_CLASSES, clamped_increments(sensor)), (NUM_CLASSES, unclamped_increments(sensor)),
        (1, clamped_increments(sensor)), (1, COUNT_SCANS),
    ):  # fmt: skip
        maps = [cells_of(_sums(frames, steps, num_classes, sensor, region)) for frames in (plain, sure)]
        assert maps[0] == maps[1]


@pytest.mark.parametrize("num_classes", [1, 3, 12])
@pytest.mark.parametrize("hit_other", [None, -0.2])
def test_weighted_sums_of_many_scans_equal_the_reference(num_classes, hit_other):
    """Clamped, unclamped and counted; scans with and without confidences in turn."""
    rng = np.random.default_rng(num_classes)
    sensor = SensorConfig(max_range=4.0, hit=0.9, miss=-0.4, hit_other=hit_other, clamp_min=-2.0, clamp_max=1.5)
    region, frames = MapConfig(0.4), []
    for frame in _mixed_scenario(lambda shape: rng.integers(0, 256, shape) if rng.random() < 0.8 else None):
        labels = "class_ids" if isinstance(frame, CloudFrame) else "class_image"
        ids = getattr(frame, labels)
        ids = np.where(ids > 0, rng.integers(1, num_classes + 1, ids.shape), 0).astype(np.uint8)
        frames.append(dataclasses.replace(frame, **{labels: ids}, boxes=_random_boxes(rng, frame, 1)))
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
    octree = _sums([frame] * 20, clamped_increments(SENSOR))
    centre = octree.find(np.array([storage.key_to_code(0, 0, 0) >> storage.CELL_BITS]))[0]
    assert octree.bricks.blocks[centre] == -1
    assert octree.bricks.values[centre] == -5.0
    assert octree.revisions[centre] < 19
