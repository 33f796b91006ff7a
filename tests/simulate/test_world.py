"""Tests of the village's mesh and its ground truth."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from plyfile import PlyData

from octoreplay.errors import OutputError
from octoreplay.simulate.village import make_village
from octoreplay.simulate.world import BUILDING, CAR, DIRT_ROAD, FENCE, GRASS, ROOF, Terrain, World, village_classes
from octoreplay.simulate.world_files import labelled_cells, write_ground_truth, write_mesh

FLAT = Terrain(np.zeros((1, 2)), np.zeros(1), np.zeros(1))


@pytest.fixture(scope="module")
def village() -> World:
    return make_village(40.0, 3)


def rectangle(z: float, x: tuple[float, float], y: tuple[float, float]) -> np.ndarray:
    return np.array([[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]])


def small_world(*parts: tuple[np.ndarray, int]) -> World:
    vertices = np.concatenate([points for points, _ in parts]).astype(np.float32)
    faces = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(len(parts))]
    classes = np.repeat(np.array([class_id for _, class_id in parts], np.uint8), 2)
    return World(10.0, FLAT, vertices, np.concatenate(faces).astype(np.int32), classes)


def random_surface_points(world: World, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points drawn uniformly over the surface and their triangles, as a reference for the regular samples."""
    rng = np.random.default_rng(0)
    corners = world.vertices[world.triangles].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = rng.choice(len(areas), count, p=areas / areas.sum())
    weights = rng.dirichlet(np.ones(3), count)
    return np.einsum("pk,pkd->pd", weights, corners[chosen]), chosen


def test_the_village_depends_on_the_seed_only(village):
    again, other = make_village(40.0, 3), make_village(40.0, 4)
    np.testing.assert_array_equal(village.vertices, again.vertices)
    np.testing.assert_array_equal(village.triangle_classes, again.triangle_classes)
    assert village.vertices.shape != other.vertices.shape or not np.array_equal(village.vertices, other.vertices)


def test_a_village_of_identical_houses_repeats_itself_from_block_to_block():
    world = make_village(70.0, 3, identical_houses=True)
    np.testing.assert_array_equal(world.terrain.height(world.vertices[:, :2]), 0.0)
    assert set(np.unique(world.triangle_classes)) == {GRASS, DIRT_ROAD, BUILDING, ROOF}
    houses = world.vertices[np.unique(world.triangles[world.triangle_classes > DIRT_ROAD])].astype(np.float64)
    # Sixteen houses: the blocks are 27 m apart, and the houses of a block 12 m.
    x, y = np.meshgrid([-19.5, -7.5, 7.5, 19.5], [-19.5, -7.5, 7.5, 19.5], indexing="ij")
    apart = np.stack([x.ravel(), y.ravel()], axis=1)
    nearest = np.argmin(np.hypot(*(houses[:, None, :2] - apart).transpose(2, 0, 1)), axis=1)
    shapes = [np.unique(np.round(houses[nearest == k] - [*apart[k], 0.0], 3), axis=0) for k in range(16)]
    assert len(shapes[0]) > 10
    for shape in shapes[1:]:
        np.testing.assert_array_equal(shape, shapes[0])
    other = make_village(70.0, 4, identical_houses=True)
    assert not np.array_equal(world.vertices, other.vertices)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_default_village_has_all_classes(seed):
    world = make_village(70.0, seed)
    assert set(np.unique(world.triangle_classes)) == set(range(1, 9))
    assert world.triangles.min() >= 0
    assert world.triangles.max() < len(world.vertices)


def test_the_ground_is_on_the_terrain_and_reaches_the_edge(village):
    ground = village.triangle_classes <= DIRT_ROAD
    corners = village.vertices[village.triangles[ground]].reshape(-1, 3).astype(np.float64)
    np.testing.assert_allclose(corners[:, 2], village.terrain.height(corners[:, :2]), atol=1e-4)
    assert (np.abs(corners[:, :2]).max(axis=0) >= village.size / 2).all()


def test_the_terrain_is_drivable_and_its_normals_are_its_gradient(village):
    xy = np.random.default_rng(0).uniform(-20, 20, (50, 2))
    normal, step = village.terrain.normal(xy), 1e-5
    for axis in range(2):
        offset = np.eye(2)[axis] * step
        slope = (village.terrain.height(xy + offset) - village.terrain.height(xy - offset)) / (2 * step)
        np.testing.assert_allclose(-normal[:, axis] / normal[:, 2], slope, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    assert (normal[:, 2] > np.cos(np.deg2rad(15))).all()


def test_sampled_points_are_on_their_triangles_and_dense():
    world = small_world((rectangle(0.5, (0.0, 2.0), (0.0, 1.0)), BUILDING))
    points = np.concatenate([batch for batch, _ in world.surface_points(0.1)])
    np.testing.assert_allclose(points[:, 2], 0.5)
    assert ((points[:, :2] > 0) & (points[:, :2] < [2.0, 1.0])).all()
    from scipy.spatial import KDTree

    anywhere = np.random.default_rng(1).uniform([0, 0], [2, 1], (500, 2))
    assert KDTree(points[:, :2]).query(anywhere)[0].max() < 0.1


def test_cells_of_a_rectangle_are_exact():
    world = small_world((rectangle(0.35, (-0.9, 0.9), (0.0, 0.6)), BUILDING))
    keys, class_ids = labelled_cells(world, 0.3)
    expected = [(i, j, 1) for i in range(-3, 3) for j in range(2)]
    assert [tuple(key) for key in keys.tolist()] == expected
    assert keys.dtype == np.int32
    assert (class_ids == BUILDING).all()


def test_a_cell_has_the_class_with_the_most_surface_and_ties_go_to_the_lower_id():
    # Two sheets in one layer of cells; the second occurs twice or once.
    for copies, expected in ((2, CAR), (1, BUILDING)):
        parts = [(rectangle(0.1, (0.0, 0.3), (0.0, 0.3)), BUILDING)]
        parts += [(rectangle(0.2, (0.0, 0.3), (0.0, 0.3)), CAR)] * copies
        keys, class_ids = labelled_cells(small_world(*parts), 0.3)
        assert keys.tolist() == [[0, 0, 0]]
        assert class_ids.tolist() == [expected]


def test_surfaces_under_the_ground_are_left_out():
    world = small_world((rectangle(0.01, (0, 0.3), (0, 0.3)), GRASS), (rectangle(-0.4, (0, 0.3), (0, 0.3)), BUILDING))
    assert labelled_cells(world, 0.3)[0].tolist() == [[0, 0, 0]]


def test_the_ground_truth_contains_the_surface(village):
    keys, class_ids = labelled_cells(village, 0.3)
    truth = dict(zip(map(tuple, keys.tolist()), class_ids.tolist(), strict=True))
    assert len(truth) == len(keys)
    points, triangles = random_surface_points(village, 20_000)
    classes = village.triangle_classes[triangles]
    visible = (classes <= DIRT_ROAD) | (points[:, 2] > village.terrain.height(points[:, :2]))
    found = [truth.get(tuple(key)) for key in np.floor(points[visible] / 0.3).astype(int).tolist()]
    known = np.array([value is not None for value in found])
    assert known.mean() > 0.995
    # A cell at the foot of a wall contains grass and wall but has one class, so not all points agree with their cell.
    agree = np.array([value == own for value, own in zip(found, classes[visible], strict=True)])
    assert agree.mean() > 0.9


@pytest.mark.parametrize("width", [0.8, 7.0, 1000.0])
def test_the_ground_truth_does_not_depend_on_the_width_of_its_slabs(monkeypatch, width):
    village = make_village(20.0, 3)
    keys, class_ids = labelled_cells(village, 0.8)
    votes: dict[tuple[int, ...], list[int]] = defaultdict(lambda: [0] * 9)
    for points, classes in village.surface_points(0.8 / 3):
        solid = (classes > DIRT_ROAD) & (points[:, 2] < village.terrain.height(points[:, :2]) - 0.05)
        for key, class_id in zip(np.floor(points / 0.8).astype(int)[~solid].tolist(), classes[~solid], strict=True):
            votes[tuple(key)][class_id] += 1
    assert [tuple(key) for key in keys.tolist()] == sorted(votes)
    assert class_ids.tolist() == [int(np.argmax(votes[key])) for key in sorted(votes)]
    monkeypatch.setattr("octoreplay.simulate.world_files._SLAB", width)
    again = labelled_cells(village, 0.8)
    np.testing.assert_array_equal(again[0], keys)
    np.testing.assert_array_equal(again[1], class_ids)


def test_objects_are_as_far_apart_as_the_gaps_between_all_their_circles(monkeypatch):
    found = make_village(40.0, 1)

    def every_circle(circles, x, y, reach, *, skip_last=False):
        others = [c for square in circles._squares.values() for c in square if not (skip_last and c is circles._last)]
        return np.array(others)

    monkeypatch.setattr("octoreplay.simulate.village._Circles.near", every_circle)
    expected = make_village(40.0, 1)
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    np.testing.assert_array_equal(found.triangle_classes, expected.triangle_classes)


def test_obstacles_are_walls_and_not_the_ground_or_roofs():
    wall = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 2.0], [1.0, -1.0, 2.0]])
    roof = rectangle(2.0, (-3.0, 0.0), (-1.0, 1.0))
    world = small_world((rectangle(0.0, (-5, 5), (-5, 5)), GRASS), (wall, BUILDING), (roof, BUILDING))
    mask = world.obstacle_mask(0.5)
    assert mask.shape == (20, 20)
    assert np.argwhere(mask).tolist() == [[12, j] for j in range(8, 12)]


def test_the_square_is_clear_and_fences_are_obstacles(village):
    mask = village.obstacle_mask(0.5)
    middle = mask.shape[0] // 2
    assert not mask[middle - 6 : middle + 6, middle - 6 : middle + 6].any()
    assert 0.01 < mask.mean() < 0.3
    points, triangles = random_surface_points(village, 20_000)
    low = points[:, 2] - village.terrain.height(points[:, :2])
    fences = points[(village.triangle_classes[triangles] == FENCE) & (low > 0.2) & (low < 1.0)]
    cells = np.floor((fences[:, :2] + village.size / 2) / 0.5).astype(int)
    cells = cells[((cells >= 0) & (cells < mask.shape[0])).all(axis=1)]
    assert len(cells) > 0
    assert mask[cells[:, 0], cells[:, 1]].mean() > 0.99


def test_the_archive_has_the_documented_arrays(tmp_path, village):
    count = write_ground_truth(tmp_path / "world.npz", village, 0.5, village_classes())
    with np.load(tmp_path / "world.npz") as archive:
        assert sorted(archive.files) == ["class_colors", "class_ids", "class_names", "keys", "resolution"]
        assert archive["keys"].shape == (count, 3)
        assert archive["keys"].dtype == np.int32
        assert archive["class_ids"].dtype == np.uint8
        assert float(archive["resolution"]) == 0.5
        assert archive["class_names"].tolist() == list(village_classes().names)
        np.testing.assert_array_equal(archive["class_colors"], village_classes().colors)
        order = np.lexsort(archive["keys"].T[::-1])
        np.testing.assert_array_equal(order, np.arange(count))


def test_the_mesh_file_equals_the_mesh(tmp_path, village):
    write_mesh(tmp_path / "world.ply", village, village_classes())
    ply = PlyData.read(str(tmp_path / "world.ply"))
    np.testing.assert_array_equal(np.stack(ply["face"]["vertex_indices"]), village.triangles)
    np.testing.assert_array_equal(ply["face"]["label"], village.triangle_classes)
    np.testing.assert_array_equal(np.stack([ply["vertex"][axis] for axis in "xyz"], axis=1), village.vertices)
    first = village_classes().classes[village.triangle_classes[0] - 1].color
    assert (ply["face"]["red"][0], ply["face"]["green"][0], ply["face"]["blue"][0]) == first


def test_files_that_cannot_be_written_are_reported(tmp_path, village):
    world = small_world((rectangle(0.0, (0, 1), (0, 1)), GRASS))
    with pytest.raises(OutputError, match=r"world\.npz: cannot be written"):
        write_ground_truth(tmp_path / "none" / "world.npz", world, 0.3, village_classes())
    with pytest.raises(OutputError, match=r"world\.ply: cannot be written"):
        write_mesh(tmp_path / "none" / "world.ply", world, village_classes())
