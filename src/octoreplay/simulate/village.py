"""Procedural village: houses, fences, roads, trees and cars on rolling ground."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.records import Float64Array, UInt8Array
from octoreplay.simulate.world import BUILDING, CAR, DIRT_ROAD, FENCE, FOLIAGE, GRASS, ROOF, TRUNK, Terrain, World

_ROAD_HALF_WIDTH = 2.0
_ROAD_SPACING = 28.0
_GROUND_STEP = 0.5
_GROUND_MARGIN = 8.0
_SQUARE_RADIUS = 8.0
_ROAD_BEND = 2.5
_HOUSE_OFFSET = 6.0
_SQUARE = 10.0


def make_village(size: float, seed: int, *, identical_houses: bool = False) -> World:
    """Return a village with a drivable square of ``size`` [m]; equal seeds give equal villages.

    Roads cross at the origin, where a disc is kept clear. Houses with gable roofs stand along the roads, some behind
    fences. Cars are parked at the roadsides, and trees stand off the roads. Gaps between objects are wide enough for
    robots.

    With ``identical_houses`` the world repeats itself: straight roads on flat ground, and in each block between them
    four copies of one house and nothing else. The seed changes the heights of the house only.
    """
    rng = np.random.default_rng([seed, 1])
    if identical_houses:
        flat = Terrain(np.zeros((1, 2)), np.zeros(1), np.zeros(1))
        village = _Builder(size, flat, _Roads(size, rng, bend=0.0), rng)
        village.add_ground()
        village.add_identical_houses(seed)
        return village.world()
    terrain = _make_terrain(rng)
    village = _Builder(size, terrain, _Roads(size, rng, bend=_ROAD_BEND), rng)
    village.add_ground()
    village.add_cars()
    village.add_houses()
    village.add_trees()
    return village.world()


class _Builder:
    """Mesh of a village under construction. ``taken`` are the circles of the placed objects."""

    def __init__(self, size: float, terrain: Terrain, roads: _Roads, rng: np.random.Generator) -> None:
        self.size = size
        self.terrain = terrain
        self.rng = rng
        self.roads = roads
        self.vertices: list[Float64Array] = []
        self.triangles: list[npt.NDArray[np.int64]] = []
        self.classes: list[UInt8Array] = []
        self.num_vertices = 0
        self.taken = _Circles()
        self.taken.append((0.0, 0.0, _SQUARE_RADIUS))

    def world(self) -> World:
        """Return the finished village."""
        return World(
            self.size,
            self.terrain,
            np.concatenate(self.vertices).astype(np.float32),
            np.concatenate(self.triangles).astype(np.int32),
            np.concatenate(self.classes),
        )

    def add(self, vertices: npt.ArrayLike, triangles: npt.ArrayLike, class_id: int | UInt8Array) -> None:
        """Append a mesh of vertices (V, 3) and triangles (T, 3)."""
        points = np.asarray(vertices, dtype=np.float64)
        faces = np.asarray(triangles, dtype=np.int64)
        self.vertices.append(points)
        self.triangles.append(faces + self.num_vertices)
        self.classes.append(np.broadcast_to(np.asarray(class_id, dtype=np.uint8), len(faces)))
        self.num_vertices += len(points)

    def add_ground(self) -> None:
        """Add a regular grid of triangles, road or grass by the distance of their centres to the roads."""
        half = self.size / 2 + _GROUND_MARGIN
        n = math.ceil(2 * half / _GROUND_STEP)
        line = np.linspace(-half, half, n + 1)
        xy = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
        corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
        lower = np.stack([corner, corner + n + 1, corner + n + 2], axis=1)
        upper = np.stack([corner, corner + n + 2, corner + 1], axis=1)
        triangles = np.concatenate([lower, upper])
        distance = self.roads.distance(xy[triangles].mean(axis=1))
        classes = np.where(distance < _ROAD_HALF_WIDTH, DIRT_ROAD, GRASS).astype(np.uint8)
        self.add(np.column_stack([xy, self.terrain.height(xy)]), triangles, classes)

    def add_houses(self) -> None:
        """Add houses along the roads, about every second one with a fence."""
        wanted = round(self.size**2 / 420)
        for _ in range(40 * wanted):
            if wanted == 0:
                return
            length, width = self.rng.uniform(6.0, 10.0), self.rng.uniform(5.0, 8.0)
            setback = _ROAD_HALF_WIDTH + 2.0 + width / 2 + self.rng.uniform(0.0, 5.0)
            x, y, yaw = self.roads.roadside(self.rng, setback)
            yaw += self.rng.normal(0.0, 0.06)
            fenced = self.rng.random() < 0.5
            radius = math.hypot(length, width) / 2 + (2.0 if fenced else 0.5)
            if not self.is_free(x, y, radius, gap=2.0) or self.nearest_road(x, y) < _ROAD_HALF_WIDTH + width / 2 + 0.5:
                continue
            self.taken.append((x, y, radius))
            self.add_house(x, y, yaw, length, width)
            if fenced:
                self.add_fence(x, y, yaw, length / 2 + 2.6, width / 2 + 2.6)
            wanted -= 1

    def add_identical_houses(self, seed: int) -> None:
        """Add four copies of one house to each block between the roads."""
        for x, y in itertools.product(self.roads.block_centers(), repeat=2):
            for dx, dy in itertools.product((-_HOUSE_OFFSET, _HOUSE_OFFSET), repeat=2):
                # Every house repeats the draws of the first.
                self.rng = np.random.default_rng([seed, 1])
                self.add_house(x + dx, y + dy, 0.0, 7.0, 5.0)

    def add_house(self, x: float, y: float, yaw: float, length: float, width: float) -> None:
        """Add one house: walls with gables, and an overhanging roof."""
        base = float(self.terrain.height((x, y)))
        eaves, ridge = self.rng.uniform(2.6, 4.2), self.rng.uniform(1.4, 2.4)
        a, b = length / 2, width / 2
        place = _Placement(x, y, base, yaw)
        walls = [(-a, -b), (a, -b), (a, b), (-a, b)]
        points = [(u, v, z) for z in (-1.2, eaves) for u, v in walls]
        points += [(a, 0.0, eaves + ridge), (-a, 0.0, eaves + ridge)]
        sides = [(i, (i + 1) % 4, (i + 1) % 4 + 4, i + 4) for i in range(4)]
        faces = [f for i, j, k, m in sides for f in ((i, j, k), (i, k, m))] + [(5, 6, 8), (7, 4, 9)]
        self.add(place(points), faces, BUILDING)
        hang = 0.5
        drop = ridge / b * hang
        c, d, low, high = a + hang, b + hang, eaves - drop, eaves + ridge
        roof = [(-c, -d, low), (c, -d, low), (c, 0, high), (-c, 0, high), (-c, d, low), (c, d, low)]
        thick = [(u, v, z + 0.12) for u, v, z in roof]
        sheets = [(0, 1, 2), (0, 2, 3), (3, 2, 5), (3, 5, 4)]
        rim = [(0, 1, 7, 6), (1, 2, 8, 7), (2, 5, 11, 8), (5, 4, 10, 11), (4, 3, 9, 10), (3, 0, 6, 9)]
        faces = sheets + [(i + 6, j + 6, k + 6) for i, j, k in sheets]
        faces += [f for i, j, k, m in rim for f in ((i, j, k), (i, k, m))]
        self.add(place(roof + thick), faces, ROOF)

    def add_fence(self, x: float, y: float, yaw: float, a: float, b: float) -> None:
        """Add fence panels around a garden, with gaps at the gate, on roads and at other objects."""
        corners = [(-a, -b), (a, -b), (a, b), (-a, b)]
        gate = float(self.rng.uniform(-0.4, 0.4)) * a
        for (u0, v0), (u1, v1) in zip(corners, corners[1:] + corners[:1], strict=True):
            count = max(1, round(math.hypot(u1 - u0, v1 - v0) / 1.5))
            for k in range(count):
                p = ((u0 + (u1 - u0) * k / count), (v0 + (v1 - v0) * k / count))
                q = ((u0 + (u1 - u0) * (k + 1) / count), (v0 + (v1 - v0) * (k + 1) / count))
                middle = ((p[0] + q[0]) / 2, (p[1] + q[1]) / 2)
                if v0 == v1 and abs(middle[0] - gate) < 1.6:
                    continue
                self.add_panel(_Placement(x, y, 0.0, yaw), p, q, middle)

    def add_panel(
        self, place: _Placement, p: tuple[float, float], q: tuple[float, float], middle: tuple[float, float]
    ) -> None:
        """Add one fence panel between two points unless a road or another object is too near."""
        (cx, cy, _), (px, py, _), (qx, qy, _) = place([(*middle, 0.0), (*p, 0.0), (*q, 0.0)])
        if self.nearest_road(cx, cy) < _ROAD_HALF_WIDTH + 0.8 or not self.is_free(cx, cy, 0.8, gap=0.0, skip_last=True):
            return
        if max(abs(cx), abs(cy)) > self.size / 2 + 2.0:
            return
        ground = float(self.terrain.height((cx, cy)))
        yaw = math.atan2(qy - py, qx - px)
        self.add_box(_Placement(cx, cy, ground, yaw), math.hypot(qx - px, qy - py) / 2, 0.04, -0.3, 1.2, FENCE)

    def add_box(self, place: _Placement, a: float, b: float, bottom: float, top: float, class_id: int) -> None:
        """Add a box with half lengths ``a`` and ``b`` between two heights."""
        points = [(u, v, z) for z in (bottom, top) for u, v in ((-a, -b), (a, -b), (a, b), (-a, b))]
        sides = [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7), (3, 2, 1, 0)]
        self.add(place(points), [f for i, j, k, m in sides for f in ((i, j, k), (i, k, m))], class_id)

    def add_cars(self) -> None:
        """Add cars parked along the roads."""
        for _ in range(round(self.roads.total_length / 22)):
            x, y, yaw = self.roads.roadside(self.rng, _ROAD_HALF_WIDTH + 0.4)
            if not self.is_free(x, y, 2.2, gap=2.0) or self.nearest_road(x, y) < _ROAD_HALF_WIDTH - 0.2:
                continue
            self.taken.append((x, y, 2.2))
            place = _Placement(x, y, float(self.terrain.height((x, y))), yaw + self.rng.normal(0.0, 0.04))
            self.add_box(place, 2.1, 0.85, 0.15, 0.85, CAR)
            self.add_box(place.moved(-0.2), 1.15, 0.75, 0.85, 1.5, CAR)

    def add_trees(self) -> None:
        """Add trees off the roads."""
        for _ in range(round(self.size**2 / 25)):
            x, y = self.rng.uniform(-self.size / 2 - 4.0, self.size / 2 + 4.0, 2)
            if not self.is_free(x, y, 0.5, gap=2.0) or self.nearest_road(x, y) < _ROAD_HALF_WIDTH + 1.2:
                continue
            self.taken.append((float(x), float(y), 0.5))
            self.add_tree(float(x), float(y))

    def add_tree(self, x: float, y: float) -> None:
        """Add one tree with an eight-sided trunk and an uneven crown, high enough to drive under."""
        ground = float(self.terrain.height((x, y)))
        radius, height = self.rng.uniform(0.15, 0.3), self.rng.uniform(2.2, 3.4)
        angles = np.arange(8) * math.pi / 4
        ring = np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)
        points = [(u, v, z) for z in (-0.4, height) for u, v in ring.tolist()]
        faces = [f for i in range(8) for f in ((i, (i + 1) % 8, (i + 1) % 8 + 8), (i, (i + 1) % 8 + 8, i + 8))]
        self.add(_Placement(x, y, ground, 0.0)(points), faces, TRUNK)
        sphere, faces = _icosphere()
        crown = self.rng.uniform(1.0, 1.9)
        sphere = sphere * (crown * self.rng.uniform(0.8, 1.1, (len(sphere), 1))) * (1.0, 1.0, 0.85)
        self.add(sphere + np.array([x, y, ground + height + 0.55 * crown]), faces, FOLIAGE)

    def is_free(self, x: float, y: float, radius: float, *, gap: float, skip_last: bool = False) -> bool:
        """True if a circle is more than ``gap`` [m] away from all placed objects."""
        others = self.taken.near(x, y, radius + gap, skip_last=skip_last)
        distance = np.hypot(others[:, 0] - x, others[:, 1] - y)
        return bool((distance > others[:, 2] + radius + gap).all())

    def nearest_road(self, x: float, y: float) -> float:
        """Return the distance [m] to the nearest centre line of a road."""
        return float(self.roads.distance(np.array([[x, y]]))[0])


class _Circles:
    """Circles (x, y, radius) [m], found by their place in squares of ``_SQUARE`` [m]."""

    def __init__(self) -> None:
        self._squares: dict[tuple[int, int], list[tuple[float, float, float]]] = defaultdict(list)
        self._largest = 0.0
        self._last: tuple[float, float, float] | None = None

    def append(self, circle: tuple[float, float, float]) -> None:
        """Add a circle."""
        x, y, radius = self._last = circle
        self._squares[math.floor(x / _SQUARE), math.floor(y / _SQUARE)].append(circle)
        self._largest = max(self._largest, radius)

    def near(self, x: float, y: float, reach: float, *, skip_last: bool = False) -> Float64Array:
        """Return the circles (K, 3) that may be at most ``reach`` [m] away, without the last one with ``skip_last``."""
        reach += self._largest
        rows, columns = (
            range(math.floor((value - reach) / _SQUARE), math.floor((value + reach) / _SQUARE) + 1) for value in (x, y)
        )
        found = [circle for place in itertools.product(rows, columns) for circle in self._squares.get(place, ())]
        if skip_last:
            found = [circle for circle in found if circle is not self._last]
        return np.array(found, dtype=np.float64).reshape(-1, 3)


@dataclass(frozen=True)
class _Placement:
    """Position and heading of an object; calling it transforms local points (P, 3) to the world."""

    x: float
    y: float
    z: float
    yaw: float

    def __call__(self, points: Any) -> Float64Array:
        local = np.asarray(points, dtype=np.float64)
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        world: Float64Array = local @ rotation.T + (self.x, self.y, self.z)
        return world

    def moved(self, forward: float) -> _Placement:
        """Return the placement moved along its heading [m]."""
        x, y = self.x + forward * math.cos(self.yaw), self.y + forward * math.sin(self.yaw)
        return _Placement(x, y, self.z, self.yaw)


class _Roads:
    """Roads along x and along y, one of each through the origin; ``lines`` are their centre lines.

    They are waves with an amplitude of ``bend`` [m].
    """

    def __init__(self, size: float, rng: np.random.Generator, bend: float) -> None:
        from scipy.spatial import KDTree

        self.half = size / 2
        # The outermost roads are 8 m inside the edge. A small world has only one crossing.
        count = round((self.half - 8.0) / _ROAD_SPACING)
        self.offsets = [k * (self.half - 8.0) / max(1, count) for k in range(-count, count + 1)]
        self.lines: list[tuple[bool, Float64Array]] = []
        along = np.arange(-self.half - _GROUND_MARGIN, self.half + _GROUND_MARGIN + 0.5, 0.5)
        for offset in self.offsets:
            for is_x in (True, False):
                wavelength, phase = rng.uniform(50.0, 80.0), rng.uniform(0.0, 2 * math.pi)
                across = offset + bend * (np.sin(2 * math.pi * along / wavelength + phase) - math.sin(phase))
                self.lines.append((is_x, np.stack([along, across] if is_x else [across, along], axis=1)))
        self._tree = KDTree(np.concatenate([line for _, line in self.lines]))

    @property
    def total_length(self) -> float:
        """Length of all roads [m]."""
        return len(self.lines) * 2 * self.half

    def block_centers(self) -> list[float]:
        """Centres of the blocks between neighbouring straight roads along one axis [m]."""
        return [(a + b) / 2 for a, b in itertools.pairwise(self.offsets)]

    def distance(self, xy: Float64Array) -> Float64Array:
        """Return distances (P,) [m] of points (P, 2) to the nearest centre line."""
        distances: Float64Array = self._tree.query(xy)[0]
        return distances

    def roadside(self, rng: np.random.Generator, setback: float) -> tuple[float, float, float]:
        """Draw a point beside a road; return its x, y [m] and the road's heading there [rad]."""
        is_x, line = self.lines[int(rng.integers(len(self.lines)))]
        inside = np.flatnonzero(np.abs(line[:, 0 if is_x else 1]) < self.half - 1.0)
        k = int(rng.choice(inside))
        direction = line[min(k + 1, len(line) - 1)] - line[k - 1]
        yaw = math.atan2(direction[1], direction[0])
        side = setback if rng.random() < 0.5 else -setback
        return float(line[k, 0] - side * math.sin(yaw)), float(line[k, 1] + side * math.cos(yaw)), yaw


def _make_terrain(rng: np.random.Generator) -> Terrain:
    """Terrain of four waves with lengths of 35 m to 70 m; slopes are below about 10 %."""
    angles = rng.uniform(0.0, 2 * math.pi, 4)
    numbers = 2 * math.pi / rng.uniform(35.0, 70.0, 4)
    vectors = numbers[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return Terrain(vectors, rng.uniform(0.0, 2 * math.pi, 4), rng.uniform(0.1, 0.3, 4))


def _icosphere() -> tuple[Float64Array, list[tuple[int, int, int]]]:
    """Unit sphere of 42 vertices and 80 triangles: an icosahedron with each face divided into four."""
    g = (1 + math.sqrt(5)) / 2
    points = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g),
              (0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]  # fmt: skip
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2),
             (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5),
             (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]  # fmt: skip
    vertices = [np.array(p, dtype=np.float64) for p in points]
    middles: dict[tuple[int, int], int] = {}

    def middle(a: int, b: int) -> int:
        edge = (min(a, b), max(a, b))
        if edge not in middles:
            middles[edge] = len(vertices)
            vertices.append((vertices[a] + vertices[b]) / 2)
        return middles[edge]

    small = []
    for a, b, c in faces:
        ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
        small += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    sphere = np.array(vertices)
    return sphere / np.linalg.norm(sphere, axis=1, keepdims=True), small
