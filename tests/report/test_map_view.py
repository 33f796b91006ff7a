"""Pictures of maps against a slow, simple drawing of the same faces."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from octoreplay.report import map_view
from octoreplay.report.map_view import BACKGROUND, Faces, View, cube_faces, draw, mesh_faces, overlay, view_of
from octoreplay.stored_map import StoredMap
from support.octree_factory import octree_of

DOWN = View(math.pi / 2, math.pi / 2, (0.0, 0.0, 0.0), 0.1, 80, 60)
"""Straight down, x to the right, y up, ten pixels to a metre."""
OBLIQUE = View(0.7, 0.6, (0.3, -0.3, 0.0), 0.16, 25, 21)


@pytest.fixture
def evenly_lit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw faces in their own colours, without light and shade."""
    monkeypatch.setattr(map_view, "_light", lambda faces, view: np.ones(len(faces.corners)))


def cubes(*places: tuple[float, float, float], color=(200, 100, 40), opacity: float = 1.0) -> Faces:
    """Cubes with an edge of 1 m."""
    count = len(places)
    return cube_faces(np.array(places), 1.0, np.tile(np.array(color, np.uint8), (count, 1)), np.full(count, opacity))


def together(*parts: Faces) -> Faces:
    return Faces(*(np.concatenate(arrays) for arrays in zip(*(part[:-1] for part in parts), strict=True)), False)


def at(picture: np.ndarray, view: View, point: tuple[float, float, float]) -> list[int]:
    """Colour of the picture at a point."""
    column, row, _ = view.project(point)
    return picture[int(row), int(column)].tolist()


# --- geometry ---------------------------------------------------------------------------------------------------------


def test_projection_of_points_by_hand() -> None:
    np.testing.assert_allclose(DOWN.project([1.0, 2.0, 3.0]), [50.0, 10.0, -3.0], atol=1e-12)
    level = View(0.0, 0.0, (0.0, 0.0, 1.0), 0.5, 80, 60)
    # The view is along x: y points to the left, and the depth grows with x.
    np.testing.assert_allclose(level.project([4.0, 2.0, 2.0]), [36.0, 28.0, 4.0], atol=1e-12)
    slanted = View(math.pi / 2, math.pi / 4, (0.0, 0.0, 0.0), 1.0, 0, 0)
    np.testing.assert_allclose(slanted.project([0.0, 1.0, 1.0]), [0.0, -math.sqrt(2.0), 0.0], atol=1e-12)


def test_a_view_is_the_closest_one_of_its_points() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-20, 30, (50, 3))
    for width, height in ((100, 400), (400, 100)):
        columns, rows, _ = view_of(points, 0.4, 0.9, width, height).project(points).T
        assert min(columns.min(), rows.min()) > -1e-6
        assert columns.max() < width + 1e-6
        assert rows.max() < height + 1e-6
        filled = np.ptp(columns) / width, np.ptp(rows) / height
        assert max(filled) == pytest.approx(1.0)
        np.testing.assert_allclose([columns.min() + columns.max(), rows.min() + rows.max()], [width, height], atol=1e-6)


def test_faces_of_cubes_without_those_between_two_cubes() -> None:
    rng = np.random.default_rng(4)
    keys = {tuple(key) for key in rng.integers(-3, 3, (60, 3)).tolist()}
    faces = cubes(*(tuple((k + 0.5) for k in key) for key in keys))
    middles = faces.corners + (faces.edges_a + faces.edges_b) / 2
    found = {
        (*middle, *normal) for middle, normal in zip(middles.round(3).tolist(), faces.normals.tolist(), strict=True)
    }
    expected = set()
    for key, axis, sign in itertools.product(keys, range(3), (-1, 1)):
        direction = [sign if k == axis else 0 for k in range(3)]
        if tuple(k + d for k, d in zip(key, direction, strict=True)) not in keys:
            expected.add((*(k + 0.5 + d / 2 for k, d in zip(key, direction, strict=True)), *map(float, direction)))
    assert found == expected
    assert len(middles) == len(expected)


# --- drawing ----------------------------------------------------------------------------------------------------------


def naive(faces: Faces, view: View) -> np.ndarray:
    """Picture drawn pixel by pixel and face by face, with one sample in the middle of a pixel and no light."""
    picture = np.zeros((view.height, view.width, 3))
    right, up, ahead = view.axes
    for row, column in itertools.product(range(view.height), range(view.width)):
        origin = (
            np.array(view.target)
            + right * (column + 0.5 - view.width / 2) * view.pixel
            - up * (row + 0.5 - view.height / 2) * view.pixel
        )
        hits = []
        for index in range(len(faces.corners)):
            if not faces.is_triangle and faces.normals[index] @ ahead > -1e-9:
                continue
            matrix = np.column_stack([faces.edges_a[index], faces.edges_b[index], -ahead])
            if abs(np.linalg.det(matrix)) < 1e-9:
                continue
            u, v, depth = np.linalg.solve(matrix, origin - faces.corners[index])
            if u >= 0 and v >= 0 and (u + v <= 1 if faces.is_triangle else u <= 1 and v <= 1):
                hits.append((depth, index))
        rest = 1.0
        for _, index in sorted(hits):
            picture[row, column] += rest * faces.opacities[index] * faces.colors[index]
            rest *= 1.0 - faces.opacities[index]
        picture[row, column] += rest * np.array(BACKGROUND)
    return np.rint(picture)


@pytest.mark.parametrize("seed", range(3))
def test_cubes_are_drawn_as_by_the_naive_way(seed: int, evenly_lit: None) -> None:
    rng = np.random.default_rng(seed)
    keys = np.unique(rng.integers(-2, 3, (12, 3)), axis=0)
    faces = cube_faces(
        (keys + 0.5) * 0.6, 0.6, rng.integers(0, 256, (len(keys), 3)).astype(np.uint8), rng.uniform(0, 1, len(keys))
    )
    assert_same(draw(faces, OBLIQUE, supersampling=1), naive(faces, OBLIQUE))


@pytest.mark.parametrize("seed", range(3))
def test_triangles_are_drawn_as_by_the_naive_way(seed: int, evenly_lit: None) -> None:
    rng = np.random.default_rng(seed)
    faces = mesh_faces(rng.uniform(-2, 2, (15, 3, 3)), rng.integers(0, 256, (15, 3)).astype(np.uint8))
    assert_same(draw(faces, OBLIQUE, supersampling=1), naive(faces, OBLIQUE))


def assert_same(picture: np.ndarray, expected: np.ndarray) -> None:
    """Check equality up to rounding, except for a few rays through edges, which may hit either face."""
    assert len(np.unique(expected.reshape(-1, 3), axis=0)) > 5
    wrong = np.abs(picture.astype(float) - expected).max(axis=2) > 1
    assert wrong.mean() < 0.003


def test_a_half_transparent_cube_mixes_its_color_with_the_background() -> None:
    solid = draw(cubes((0.5, 0.5, 0.5)), DOWN)
    half = draw(cubes((0.5, 0.5, 0.5), opacity=0.5), DOWN)
    top = (0.5, 0.5, 1.0)
    # 0.62 from the sky, and 0.56 from the sun at the angle between its direction (0.6, 0, 0.75) and the vertical.
    light = 0.62 + 0.56 * 0.75 / math.hypot(0.6, 0.75)
    np.testing.assert_allclose(at(solid, DOWN, top), np.array([200, 100, 40]) * light, atol=0.51)
    np.testing.assert_allclose(
        at(half, DOWN, top), (np.array([200, 100, 40]) * light + np.array(BACKGROUND)) / 2, atol=0.51
    )
    assert at(half, DOWN, (-0.5, 0.5, 1.0)) == list(BACKGROUND)


def test_a_nearer_cube_covers_a_farther_one(evenly_lit: None) -> None:
    near, far = (10, 200, 30), (250, 0, 90)
    for opacity in (1.0, 0.25):
        faces = together(cubes((0.5, 0.5, 0.5), color=far), cubes((0.5, 0.5, 4.5), color=near, opacity=opacity))
        expected = opacity * np.array(near) + (1 - opacity) * np.array(far)
        np.testing.assert_allclose(at(draw(faces, DOWN), DOWN, (0.5, 0.5, 0.0)), expected, atol=0.51)


def test_a_face_in_the_shade_is_darker() -> None:
    ground = mesh_faces(
        np.array([[(x, y, 0.0), (x + 0.1, y, 0.0), (x, y + 0.1, 0.0)] for x, y in ((-0.55, 0.45), (1.45, 0.45))]),
        np.full((2, 3), 200, np.uint8),
    )
    house = cubes((0.5, 0.5, 0.5))
    flat = together(house, Faces(*ground[:-1], False))
    picture = draw(flat, View(DOWN.azimuth, DOWN.elevation, DOWN.target, 0.02, 400, 300))
    view = View(DOWN.azimuth, DOWN.elevation, DOWN.target, 0.02, 400, 300)
    shaded, sunny = at(picture, view, (-0.5, 0.5, 0.0)), at(picture, view, (1.5, 0.5, 0.0))
    np.testing.assert_allclose(shaded, np.full(3, 200 * 0.62), atol=0.51)
    assert sunny[0] > 1.3 * shaded[0]


def test_a_picture_without_faces_is_background() -> None:
    picture = draw(cubes((100.0, 100.0, 0.5)), DOWN)
    assert (picture == BACKGROUND).all()


def test_too_many_faces_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_view, "_MAX_FACES", 5)
    with pytest.raises(ValueError, match="6 are more than the 5 that can be drawn"):
        draw(cubes((0.5, 0.5, 0.5)), DOWN)


# --- overlays ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("prior", [0.0, -0.7, 0.4])
def test_an_overlay_has_the_label_of_the_mean_and_the_largest_distance(prior: float) -> None:
    rng = np.random.default_rng(5)
    keys = [tuple(key) for key in np.unique(rng.integers(-5, 5, (150, 3)), axis=0).tolist()]
    known = [{key: rng.normal(0, 1, 2).astype(np.float32) for key in keys if rng.random() < 0.6} for _ in range(3)]
    maps = [StoredMap(octree_of(cells), f"r{i}", 1, 0, prior, 3) for i, cells in enumerate(known)]
    found = overlay(maps)
    expected = {}
    for key in keys:
        values = [cells.get(key, np.zeros(2)) for cells in known]
        mean = np.mean(values, axis=0) + prior
        if any(key in cells for cells in known) and mean.max() > 0:
            distances = [np.linalg.norm(a - b) for a, b in itertools.combinations(values, 2)]
            expected[tuple((k + 0.5) * 0.25 for k in key)] = (int(mean.argmax()) + 1, max(distances))
    centers = [tuple(center) for center in found.centers.tolist()]
    assert set(centers) == set(expected)
    assert found.resolution == 0.25
    for center, label, deviation in zip(centers, found.labels.tolist(), found.deviations.tolist(), strict=True):
        assert label == expected[center][0]
        assert deviation == pytest.approx(expected[center][1], rel=1e-5)


def test_opacities_decrease_with_the_deviation() -> None:
    np.testing.assert_allclose(
        map_view.opacities(np.array([0.0, 1.0, 3.0, 4.0, 9.0]), 4.0), [1.0, 0.75, 0.25, 0.1, 0.1]
    )
    np.testing.assert_array_equal(map_view.opacities(np.zeros(2), 0.0), [1.0, 1.0])
