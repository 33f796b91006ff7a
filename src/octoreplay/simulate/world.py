"""A procedural village as a triangle mesh with one class per triangle, and its ground truth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from octoreplay.errors import OutputError
from octoreplay.mapping.surface import CellVotes, points_on_triangles
from octoreplay.records import BoolArray, ClassTable, Color, Float64Array, Int32Array, SemanticClass, UInt8Array

GRASS, DIRT_ROAD, BUILDING, ROOF, TRUNK, FOLIAGE, FENCE, CAR = range(1, 9)

_CLASSES = (
    ("grass", (124, 179, 66)),
    ("dirt_road", (161, 122, 82)),
    ("building", (224, 209, 178)),
    ("roof", (183, 58, 46)),
    ("trunk", (96, 62, 35)),
    ("foliage", (27, 108, 48)),
    ("fence", (240, 196, 60)),
    ("car", (41, 98, 201)),
)
"""Names and colours of the classes 1 to 8."""
MAX_KINDS = 31
"""Most kinds of each class: ids and raw labels are below 255."""


def village_classes(kinds: int = 1) -> ClassTable:
    """The village's classes; with several ``kinds`` of each, grass_1, grass_2 and so on, the later ones darker.

    The raw label of a class is its class_id, and 255 marks pixels without a measurement.
    """
    rows = [
        (name if kinds == 1 else f"{name}_{kind + 1}", tuple(round(c * (1.0 - 0.5 * kind / kinds)) for c in color))
        for name, color in _CLASSES
        for kind in range(kinds)
    ]
    return ClassTable(
        tuple(SemanticClass(i, name, cast("Color", color), (i,)) for i, (name, color) in enumerate(rows, 1)),
        ignored_raw_labels=(255,),
    )


_ROAD_HALF_WIDTH = 2.0
_ROAD_SPACING = 28.0
_GROUND_STEP = 0.5
_GROUND_MARGIN = 8.0
_SQUARE_RADIUS = 8.0
_KIND_SQUARE = 8.0


@dataclass(frozen=True, eq=False)
class Terrain:
    """Gently rolling ground: a sum of plane waves, so that height and slope are known everywhere.

    ``wave_vectors`` (W, 2) in rad/m, ``phases`` (W,) in rad, ``amplitudes`` (W,) in m.
    """

    wave_vectors: Float64Array
    phases: Float64Array
    amplitudes: Float64Array

    def height(self, xy: npt.ArrayLike) -> Float64Array:
        """Height in metres at points (..., 2)."""
        waves: Float64Array = np.sin(np.asarray(xy) @ self.wave_vectors.T + self.phases) @ self.amplitudes
        return waves

    def normal(self, xy: npt.ArrayLike) -> Float64Array:
        """Upward unit normals (..., 3) at points (..., 2)."""
        slopes = (np.cos(np.asarray(xy) @ self.wave_vectors.T + self.phases) * self.amplitudes) @ self.wave_vectors
        normals = np.concatenate([-slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1)
        unit: Float64Array = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
        return unit


@dataclass(frozen=True, eq=False)
class World:
    """The village: ``vertices`` (V, 3) float32 in metres, ``triangles`` (T, 3) int32, ``triangle_classes`` (T,) uint8.

    Robots may drive where |x| and |y| are at most ``size`` / 2; the ground goes on a little further. The classes are
    those of ``village_classes(kinds)``.
    """

    size: float
    terrain: Terrain
    vertices: npt.NDArray[np.float32]
    triangles: Int32Array
    triangle_classes: UInt8Array
    kinds: int = 1

    def is_ground(self, class_ids: UInt8Array) -> BoolArray:
        """Which classes (P,) are grass or road of any kind."""
        is_ground: BoolArray = class_ids <= DIRT_ROAD * self.kinds
        return is_ground

    def with_kinds(self, kinds: int) -> World:
        """The same village with so many kinds of each class: what lies in one square of 8 m is of one kind."""
        middles = self.vertices[self.triangles].mean(axis=1)[:, :2]
        squares = np.floor(middles / _KIND_SQUARE).astype(np.int64)
        kind = (squares[:, 0] * 7 + squares[:, 1] * 3) % kinds
        classes = (self.triangle_classes.astype(np.int64) - 1) * kinds + kind + 1
        return dataclasses.replace(self, triangle_classes=classes.astype(np.uint8), kinds=kinds)

    def surface_points(self, spacing: float) -> Iterator[tuple[Float64Array, UInt8Array]]:
        """Batches of points (P, 3) that lie at most ``spacing`` apart on all surfaces, with their classes (P,).

        They are those of ``points_on_triangles``.
        """
        corners = self.vertices[self.triangles].astype(np.float64)
        for points, triangles in points_on_triangles(corners, spacing):
            yield points, self.triangle_classes[triangles]

    def obstacle_mask(self, cell: float) -> npt.NDArray[np.bool_]:
        """Where a robot cannot drive, (n, n) bool over x, y from -size/2 in steps of ``cell`` metres.

        A cell is blocked when anything but ground stands between 0.1 m and 1.5 m above the ground in it.
        """
        n = grid_length(self.size, cell)
        mask = np.zeros((n, n), dtype=np.bool_)
        for points, class_ids in self.surface_points(cell / 2):
            solid = points[~self.is_ground(class_ids)]
            above = solid[:, 2] - self.terrain.height(solid[:, :2])
            index = np.floor((solid[(above > 0.1) & (above < 1.5), :2] + self.size / 2) / cell).astype(np.int64)
            index = index[((index >= 0) & (index < n)).all(axis=1)]
            mask[index[:, 0], index[:, 1]] = True
        return mask


def grid_length(size: float, cell: float) -> int:
    """Cells along one side of a square grid that covers ``size`` metres."""
    return math.ceil(size / cell - 1e-9)


def make_village(size: float, seed: int) -> World:
    """A village with a drivable square of ``size`` metres, the same for the same seed.

    Roads cross at the origin, where a square is kept clear; houses with gable roofs stand along the roads, some behind
    fences; cars are parked at the roadsides and trees grow in between. Gaps between things are wide enough to drive.
    """
    rng = np.random.default_rng([seed, 1])
    terrain = _make_terrain(rng)
    village = _Builder(size, terrain, rng)
    village.add_ground()
    village.add_cars()
    village.add_houses()
    village.add_trees()
    return village.world()


def labelled_cells(world: World, resolution: float) -> tuple[Int32Array, UInt8Array]:
    """The ground truth: keys (M, 3) int32 of the finest cells that hold a surface, and class ids (M,) uint8.

    key = floor(coordinate / resolution). Surfaces are sampled every third of a cell's edge; the class with the most
    points in a cell wins, ties go to the lower id. What lies under the ground is left out. Keys are in ascending order.
    """
    votes = CellVotes()
    for points, class_ids in world.surface_points(resolution / 3):
        buried = ~world.is_ground(class_ids) & (points[:, 2] < world.terrain.height(points[:, :2]) - 0.05)
        keys = np.floor(points[~buried] / resolution).astype(np.int64) + _KEY_OFFSET
        votes.add(((keys[:, 0] << 18) + keys[:, 1] << 18) + keys[:, 2], class_ids[~buried])
    cells, winners = votes.winners()
    mask = (1 << 18) - 1
    keys = np.stack([cells >> 36, (cells >> 18) & mask, cells & mask], axis=1) - _KEY_OFFSET
    return keys.astype(np.int32), winners


_KEY_OFFSET = 1 << 17


def write_ground_truth(path: Path, world: World, resolution: float, class_table: ClassTable) -> int:
    """Write the labelled cells as a NumPy archive (docs/simulation.md) and return their number.

    Raises OutputError where the file cannot be written.
    """
    keys, class_ids = labelled_cells(world, resolution)
    try:
        np.savez_compressed(
            path,
            keys=keys,
            class_ids=class_ids,
            resolution=np.float64(resolution),
            class_names=np.array(class_table.names),
            class_colors=class_table.colors,
        )
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
    return len(class_ids)


def write_mesh(path: Path, world: World, class_table: ClassTable) -> None:
    """Write the mesh as binary PLY: faces with red, green, blue and label. Raises OutputError."""
    from plyfile import PlyData, PlyElement

    vertices = np.empty(len(world.vertices), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    for axis, name in enumerate("xyz"):
        vertices[name] = world.vertices[:, axis]
    faces = np.empty(
        len(world.triangles),
        dtype=[("vertex_indices", "<i4", (3,)), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("label", "u1")],
    )
    faces["vertex_indices"] = world.triangles
    faces["label"] = world.triangle_classes
    colors = class_table.colors[world.triangle_classes - 1]
    for channel, name in enumerate(("red", "green", "blue")):
        faces[name] = colors[:, channel]
    names = ", ".join(f"{c.class_id} {c.name}" for c in class_table.classes)
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    try:
        PlyData(elements, byte_order="<", comments=[f"labels: {names}"]).write(str(path))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


class _Builder:
    """Collects the village's parts; everything that stands somewhere is kept apart from everything else."""

    def __init__(self, size: float, terrain: Terrain, rng: np.random.Generator) -> None:
        self.size = size
        self.terrain = terrain
        self.rng = rng
        self.roads = _Roads(size, rng)
        self.vertices: list[Float64Array] = []
        self.triangles: list[npt.NDArray[np.int64]] = []
        self.classes: list[UInt8Array] = []
        self.num_vertices = 0
        self.taken: list[tuple[float, float, float]] = [(0.0, 0.0, _SQUARE_RADIUS)]

    def world(self) -> World:
        """The finished village."""
        return World(
            self.size,
            self.terrain,
            np.concatenate(self.vertices).astype(np.float32),
            np.concatenate(self.triangles).astype(np.int32),
            np.concatenate(self.classes),
        )

    def add(self, vertices: npt.ArrayLike, triangles: npt.ArrayLike, class_id: int | UInt8Array) -> None:
        """Append one part."""
        points = np.asarray(vertices, dtype=np.float64)
        faces = np.asarray(triangles, dtype=np.int64)
        self.vertices.append(points)
        self.triangles.append(faces + self.num_vertices)
        self.classes.append(np.broadcast_to(np.asarray(class_id, dtype=np.uint8), len(faces)))
        self.num_vertices += len(points)

    def add_ground(self) -> None:
        """A regular grid of triangles, grass or road by the distance of their centres to the roads."""
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
        """Houses along the roads, about every second one behind a fence."""
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

    def add_house(self, x: float, y: float, yaw: float, length: float, width: float) -> None:
        """Walls with gables, and a roof that overhangs."""
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
        """Panels around a garden, with gaps at the gate, on roads and where something else stands."""
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
        """One thin fence panel between two points, unless it would stand in the way."""
        (cx, cy, _), (px, py, _), (qx, qy, _) = place([(*middle, 0.0), (*p, 0.0), (*q, 0.0)])
        if self.nearest_road(cx, cy) < _ROAD_HALF_WIDTH + 0.8 or not self.is_free(cx, cy, 0.8, gap=0.0, skip_last=True):
            return
        if max(abs(cx), abs(cy)) > self.size / 2 + 2.0:
            return
        ground = float(self.terrain.height((cx, cy)))
        yaw = math.atan2(qy - py, qx - px)
        self.add_box(_Placement(cx, cy, ground, yaw), math.hypot(qx - px, qy - py) / 2, 0.04, -0.3, 1.2, FENCE)

    def add_box(self, place: _Placement, a: float, b: float, bottom: float, top: float, class_id: int) -> None:
        """A box of half lengths a and b between two heights."""
        points = [(u, v, z) for z in (bottom, top) for u, v in ((-a, -b), (a, -b), (a, b), (-a, b))]
        sides = [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7), (3, 2, 1, 0)]
        self.add(place(points), [f for i, j, k, m in sides for f in ((i, j, k), (i, k, m))], class_id)

    def add_cars(self) -> None:
        """Cars parked along the roads."""
        for _ in range(round(self.roads.total_length / 22)):
            x, y, yaw = self.roads.roadside(self.rng, _ROAD_HALF_WIDTH + 0.4)
            if not self.is_free(x, y, 2.2, gap=2.0) or self.nearest_road(x, y) < _ROAD_HALF_WIDTH - 0.2:
                continue
            self.taken.append((x, y, 2.2))
            place = _Placement(x, y, float(self.terrain.height((x, y))), yaw + self.rng.normal(0.0, 0.04))
            self.add_box(place, 2.1, 0.85, 0.15, 0.85, CAR)
            self.add_box(place.moved(-0.2), 1.15, 0.75, 0.85, 1.5, CAR)

    def add_trees(self) -> None:
        """Trees off the roads: an eight-sided trunk and an uneven crown."""
        for _ in range(round(self.size**2 / 25)):
            x, y = self.rng.uniform(-self.size / 2 - 4.0, self.size / 2 + 4.0, 2)
            if not self.is_free(x, y, 0.5, gap=2.0) or self.nearest_road(x, y) < _ROAD_HALF_WIDTH + 1.2:
                continue
            self.taken.append((float(x), float(y), 0.5))
            self.add_tree(float(x), float(y))

    def add_tree(self, x: float, y: float) -> None:
        """One tree; the crown hangs high enough to drive under."""
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
        """True when a circle keeps the gap to everything that stands so far."""
        others = np.array(self.taken[:-1] if skip_last else self.taken)
        distance = np.hypot(others[:, 0] - x, others[:, 1] - y)
        return bool((distance > others[:, 2] + radius + gap).all())

    def nearest_road(self, x: float, y: float) -> float:
        """Distance to the nearest road's centre line."""
        return float(self.roads.distance(np.array([[x, y]]))[0])


@dataclass(frozen=True)
class _Placement:
    """Moves local points to a place and heading in the world."""

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
        """The same heading, some metres further."""
        x, y = self.x + forward * math.cos(self.yaw), self.y + forward * math.sin(self.yaw)
        return _Placement(x, y, self.z, self.yaw)


class _Roads:
    """Wavy roads along x and along y; one of each passes through the origin."""

    def __init__(self, size: float, rng: np.random.Generator) -> None:
        self.half = size / 2
        # The outermost roads run 8 m inside the edge; a small world has one crossing only.
        count = round((self.half - 8.0) / _ROAD_SPACING)
        offsets = [k * (self.half - 8.0) / max(1, count) for k in range(-count, count + 1)]
        self.lines: list[tuple[bool, Float64Array]] = []
        along = np.arange(-self.half - _GROUND_MARGIN, self.half + _GROUND_MARGIN + 0.5, 0.5)
        for offset in offsets:
            for is_x in (True, False):
                wavelength, phase = rng.uniform(50.0, 80.0), rng.uniform(0.0, 2 * math.pi)
                across = offset + 2.5 * (np.sin(2 * math.pi * along / wavelength + phase) - math.sin(phase))
                self.lines.append((is_x, np.stack([along, across] if is_x else [across, along], axis=1)))
        self.points = np.concatenate([line for _, line in self.lines])

    @property
    def total_length(self) -> float:
        """Length of all roads in metres."""
        return len(self.lines) * 2 * self.half

    def distance(self, xy: Float64Array) -> Float64Array:
        """Distance (P,) of points (P, 2) to the nearest centre line."""
        from scipy.spatial import KDTree

        distances: Float64Array = KDTree(self.points).query(xy)[0]
        return distances

    def roadside(self, rng: np.random.Generator, setback: float) -> tuple[float, float, float]:
        """A place beside a road (x, y) and the road's heading there."""
        is_x, line = self.lines[int(rng.integers(len(self.lines)))]
        inside = np.flatnonzero(np.abs(line[:, 0 if is_x else 1]) < self.half - 1.0)
        k = int(rng.choice(inside))
        direction = line[min(k + 1, len(line) - 1)] - line[k - 1]
        yaw = math.atan2(direction[1], direction[0])
        side = setback if rng.random() < 0.5 else -setback
        return float(line[k, 0] - side * math.sin(yaw)), float(line[k, 1] + side * math.cos(yaw)), yaw


def _make_terrain(rng: np.random.Generator) -> Terrain:
    """Four waves of 35 m to 70 m; slopes stay below about 10 %."""
    angles = rng.uniform(0.0, 2 * math.pi, 4)
    numbers = 2 * math.pi / rng.uniform(35.0, 70.0, 4)
    vectors = numbers[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return Terrain(vectors, rng.uniform(0.0, 2 * math.pi, 4), rng.uniform(0.1, 0.3, 4))


def _icosphere() -> tuple[Float64Array, list[tuple[int, int, int]]]:
    """A unit sphere of 42 vertices and 80 triangles: an icosahedron, each face cut into four."""
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
