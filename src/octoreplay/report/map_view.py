"""Oblique bird's-eye pictures of maps: shaded cubes or triangles with real transparency, drawn with NumPy alone.

The camera is orthographic. Every face is cut into pixels row by row, the pieces of a pixel are sorted by depth and
blended front to back, so that any number of transparent cells may lie behind each other. The sun is drawn the same way
from its own side: what reaches a face is its light. The same input gives the same picture.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octoreplay.log_odds import best_labels
from octoreplay.mapping.octree import codes_to_keys
from octoreplay.records import Float64Array, Int64Array, UInt8Array, UInt64Array
from octoreplay.result import StoredMap

BACKGROUND = (236, 239, 243)
"""Not white, so that pale and transparent differ."""

_SUN = (0.6, 0.45, 0.75)
"""Where the sun stands, for somebody who looks along the view: to the right, behind him, above."""
_AMBIENT, _SKY, _SUNLIGHT = 0.56, 0.06, 0.56
_SUN_PIXELS = 8192
"""Widest and highest picture from the sun's side."""
_BAND_PIXELS = 1 << 20
_FACE_BITS, _DEPTH_BITS = 22, 20
_MAX_FACES = 1 << _FACE_BITS

_DIRECTIONS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


@dataclass(frozen=True)
class View:
    """An orthographic camera that looks obliquely down.

    ``azimuth`` is where it looks, counter-clockwise from x, ``elevation`` how far down, both in radians; ``target``
    (x, y, z) in metres is in the picture's middle; ``pixel`` is a pixel's edge in metres; ``width`` and ``height`` are
    in pixels.
    """

    azimuth: float
    elevation: float
    target: tuple[float, float, float]
    pixel: float
    width: int
    height: int

    @property
    def axes(self) -> Float64Array:
        """(3, 3): rows are the picture's right, its up, and the direction of view."""
        cos_a, sin_a = math.cos(self.azimuth), math.sin(self.azimuth)
        cos_e, sin_e = math.cos(self.elevation), math.sin(self.elevation)
        return np.array(
            [[sin_a, -cos_a, 0.0], [cos_a * sin_e, sin_a * sin_e, cos_e], [cos_a * cos_e, sin_a * cos_e, -sin_e]]
        )

    def project(self, points: npt.ArrayLike) -> Float64Array:
        """Columns and rows in pixels from the upper left corner, and depths in metres: (..., 3) of (..., 3)."""
        seen = (np.asarray(points, np.float64) - self.target) @ self.axes.T
        half = (self.width / 2, self.height / 2)
        return np.stack(
            [seen[..., 0] / self.pixel + half[0], half[1] - seen[..., 1] / self.pixel, seen[..., 2]], axis=-1
        )

    def scaled(self, factor: int) -> View:
        """The same view in pixels so many times finer."""
        return View(
            self.azimuth, self.elevation, self.target, self.pixel / factor, self.width * factor, self.height * factor
        )


def view_of(points: npt.ArrayLike, azimuth: float, elevation: float, width: int, height: int) -> View:
    """The view that just holds points (P, 3) in metres, in the middle of the picture."""
    points = np.asarray(points, np.float64)
    turned = View(azimuth, elevation, (0.0, 0.0, 0.0), 1.0, 0, 0)
    seen = points @ turned.axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    pixel = max(float((high[0] - low[0]) / width), float((high[1] - low[1]) / height), 1e-6)
    x, y, z = ((low + high) / 2 @ turned.axes).tolist()
    return View(azimuth, elevation, (x, y, z), pixel, width, height)


class Faces(NamedTuple):
    """Flat faces in space: a corner (F, 3) and two edges from it (F, 3) each, in metres.

    They are parallelograms, or with ``is_triangle`` the halves of them at the corner. ``normals`` (F, 3) are unit
    vectors; zero where a face is seen from both sides. ``colors`` (F, 3) from 0 to 255, ``opacities`` (F,) from 0 to 1.
    """

    corners: Float64Array
    edges_a: Float64Array
    edges_b: Float64Array
    normals: Float64Array
    colors: Float64Array
    opacities: Float64Array
    is_triangle: bool

    def taken(self, rows: Int64Array) -> Faces:
        """Some of the faces."""
        return Faces(
            self.corners[rows], self.edges_a[rows], self.edges_b[rows], self.normals[rows], self.colors[rows],
            self.opacities[rows], self.is_triangle,
        )  # fmt: skip


class Overlay(NamedTuple):
    """Several robots' maps in one: the finest cells that the mean of their log-odds calls occupied, in Morton order.

    ``centers`` (M, 3) float64 in metres; ``labels`` (M,) uint8, the most probable class of the mean; ``deviations``
    (M,) float64, the largest ||h_i - h_j|| over the pairs of robots, where an unknown cell counts as the prior.
    """

    centers: Float64Array
    labels: UInt8Array
    deviations: Float64Array
    resolution: float


def overlay(maps: Sequence[StoredMap]) -> Overlay:
    """The maps of one team at one time, laid over each other."""
    spans = [stored.octree.spans() for stored in maps]
    prior = np.float32(maps[0].prior)
    # A mean above zero needs a robot above zero: all other cells are free.
    chosen = [np.any(span.deviations + prior > 0, axis=1) | bool(prior > 0) for span in spans]
    codes = np.unique(np.concatenate([span.cells_in(rows) for span, rows in zip(spans, chosen, strict=True)]))
    values = np.stack([span.deviations_at(codes) for span in spans])
    mean = values.mean(axis=0) + prior
    labels = best_labels(mean)
    occupied = labels > 0
    values = values[:, occupied].astype(np.float64)
    largest = np.zeros(int(occupied.sum()))
    for index, own in enumerate(values):
        for other in values[index + 1 :]:
            np.maximum(largest, np.square(own - other).sum(axis=1), out=largest)
    resolution = maps[0].resolution
    centers: Float64Array = (codes_to_keys(codes[occupied]).astype(np.float64) + 0.5) * resolution
    return Overlay(centers, labels[occupied], np.sqrt(largest), resolution)


def opacities(deviations: Float64Array, largest: float, least: float = 0.1) -> Float64Array:
    """1 - d / ``largest``, not below ``least``: what the team agrees on is solid, what one robot holds alone is not."""
    shares = deviations / largest if largest > 0 else np.zeros(len(deviations))
    return np.clip(1.0 - shares, least, 1.0)


def cube_faces(centers: Float64Array, edge: float, colors: UInt8Array, opacities: Float64Array) -> Faces:
    """The faces of cubes with centres (M, 3) on a grid of ``edge``, both in metres, but those between two cubes.

    ``colors`` (M, 3) uint8, ``opacities`` (M,) from 0 to 1.
    """
    keys = np.floor(centers / edge).astype(np.int64)
    packed = _packed(keys)
    cubes, sides = [], []
    for side, direction in enumerate(_DIRECTIONS):
        exposed = np.flatnonzero(~np.isin(_packed(keys + direction), packed))
        cubes.append(exposed)
        sides.append(np.full(len(exposed), side))
    cube, normals = np.concatenate(cubes), _DIRECTIONS[np.concatenate(sides)].astype(np.float64)
    first, second = np.roll(np.abs(normals), 1, axis=1), np.roll(np.abs(normals), 2, axis=1)
    corners = centers[cube] + (normals - first - second) * edge / 2
    shades = colors[cube].astype(np.float64)
    return Faces(corners, first * edge, second * edge, normals, shades, opacities[cube], is_triangle=False)


def mesh_faces(corners: Float64Array, colors: UInt8Array) -> Faces:
    """Solid triangles with corners (T, 3, 3) in metres and colours (T, 3) uint8, seen from both sides."""
    edges_a, edges_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(edges_a, edges_b)
    lengths = np.linalg.norm(normals, axis=1)
    keep = lengths > 0
    return Faces(
        corners[keep, 0], edges_a[keep], edges_b[keep], normals[keep] / lengths[keep, None],
        colors[keep].astype(np.float64), np.ones(int(keep.sum())), is_triangle=True,
    )  # fmt: skip


def draw(faces: Faces, view: View, supersampling: int = 2) -> UInt8Array:
    """The picture (height, width, 3) uint8 of faces over the background.

    Every pixel is the mean of ``supersampling`` squared finer ones. Raises ValueError for more than 4 million faces.
    """
    if len(faces.corners) > _MAX_FACES:
        raise ValueError(f"faces: {len(faces.corners)} are more than can be drawn, {_MAX_FACES}")
    lit = faces._replace(colors=faces.colors * _light(faces, view)[:, None])
    fine = view.scaled(supersampling)
    picture = np.empty((view.height, view.width, 3), np.uint8)
    for rows, pieces in _bands(_towards(lit, view), fine, supersampling):
        blended = _blended(pieces, (rows.stop - rows.start) * fine.width)
        blended = blended.reshape(-1, supersampling, view.width, supersampling, 3).mean(axis=(1, 3))
        picture[rows.start // supersampling : rows.stop // supersampling] = np.rint(np.clip(blended, 0, 255))
    return picture


def _packed(keys: Int64Array) -> Int64Array:
    """One integer for each key of a cell (M, 3) and of its neighbours."""
    packed: Int64Array = (keys + (1 << 19)) @ np.array([1 << 40, 1 << 20, 1], dtype=np.int64)
    return packed


def _facing(faces: Faces, direction: Float64Array) -> Int64Array:
    """The faces that somebody who looks along a direction can see; triangles are seen from both sides."""
    if faces.is_triangle:
        return np.arange(len(faces.corners))
    return np.flatnonzero(faces.normals @ direction < -1e-9)


def _towards(faces: Faces, view: View) -> Faces:
    """The faces that look towards the camera."""
    return faces.taken(_facing(faces, view.axes[2]))


def _light(faces: Faces, view: View) -> Float64Array:
    """How bright each face (F,) is: what the sky gives, and what the sun does where it is not hidden."""
    right, _, ahead = view.axes
    level = np.array([ahead[0], ahead[1], 0.0]) / max(math.hypot(ahead[0], ahead[1]), 1e-9)
    sun = _SUN[0] * right - _SUN[1] * level + (0.0, 0.0, _SUN[2])
    sun /= np.linalg.norm(sun)
    normals = faces.normals
    if faces.is_triangle:
        normals = np.where((normals @ ahead > 0)[:, None], -normals, normals)
    light: Float64Array = _AMBIENT + _SKY * normals[:, 2]
    light += _SUNLIGHT * np.maximum(normals @ sun, 0.0) * _reached(faces, sun, view.pixel)
    return light


def _reached(faces: Faces, sun: Float64Array, pixel: float) -> Float64Array:
    """The share of the sun's light that gets to each face (F,), past all others; 1 where no sunbeam was tried."""
    chosen = _facing(faces, -sun)
    view = View(math.atan2(-sun[1], -sun[0]), math.asin(sun[2]), (0.0, 0.0, 0.0), pixel, 0, 0)
    ends = faces.corners + np.stack([0 * faces.edges_a, faces.edges_a, faces.edges_b, faces.edges_a + faces.edges_b])
    seen = view.project(ends).reshape(-1, 3)
    low, high = seen.min(axis=0, initial=0.0), seen.max(axis=0, initial=0.0)
    width, height = (max(1, min(_SUN_PIXELS, 2 * math.ceil(max(-low[k], high[k])))) for k in range(2))
    view = View(view.azimuth, view.elevation, view.target, pixel, width, height)
    shares, counts = np.zeros(len(chosen)), np.zeros(len(chosen))
    for _, pieces in _bands(_towards(faces, view), view, 1):
        shares += np.bincount(pieces.faces, pieces.through, minlength=len(chosen))
        counts += np.bincount(pieces.faces, minlength=len(chosen))
    reached = np.ones(len(faces.corners))
    reached[chosen[counts > 0]] = shares[counts > 0] / counts[counts > 0]
    return reached


class _Pieces(NamedTuple):
    """What one band of a picture shows of faces, by pixel and then by depth.

    ``pixels`` (P,) of the band, ``faces`` (P,), their ``colors`` (P, 3) and opacities ``alphas`` (P,), and ``through``
    (P,): the share of light that gets past everything nearer.
    """

    pixels: Int64Array
    faces: Int64Array
    colors: Float64Array
    alphas: Float64Array
    through: Float64Array


def _bands(faces: Faces, view: View, multiple: int) -> Iterator[tuple[slice, _Pieces]]:
    """The picture in bands of rows, each a multiple of so many, with the pieces in it."""
    planes = _Planes.of(faces, view)
    num_rows = max(multiple, _BAND_PIXELS // view.width // multiple * multiple)
    for first in range(0, view.height, num_rows):
        rows = slice(first, min(first + num_rows, view.height))
        keys = planes.pieces(rows, view.width)
        pixels = (keys >> np.uint64(_FACE_BITS + _DEPTH_BITS)).astype(np.int64)
        face = (keys & np.uint64(_MAX_FACES - 1)).astype(np.int64)
        alphas = faces.opacities[face]
        yield rows, _Pieces(pixels, face, faces.colors[face], alphas, _through(pixels, alphas))


def _through(pixels: Int64Array, alphas: Float64Array) -> Float64Array:
    """The share of light (P,) that gets past the nearer pieces of the same pixel: the product of 1 - alpha."""
    passed = np.concatenate([[0.0], np.cumsum(np.log(np.maximum(1.0 - alphas, 1e-12)))])[:-1]
    starts = np.flatnonzero(np.diff(pixels, prepend=-1))
    lengths = np.diff(starts, append=len(pixels))
    through: Float64Array = np.exp(passed - np.repeat(passed[starts], lengths))
    return through


def _blended(pieces: _Pieces, num_pixels: int) -> Float64Array:
    """The colours (num_pixels, 3) of a band over the background."""
    weights = pieces.through * pieces.alphas
    rest = 1.0 - np.bincount(pieces.pixels, weights, minlength=num_pixels)
    colors: Float64Array = np.outer(rest, np.asarray(BACKGROUND, np.float64))
    for channel in range(3):
        colors[:, channel] += np.bincount(pieces.pixels, weights * pieces.colors[:, channel], minlength=num_pixels)
    return colors


class _Planes(NamedTuple):
    """Faces as seen: where each is in a picture, as linear functions of column and row.

    ``rows`` (F, 2) are the first row and the one after the last; ``bounds`` (4, 3, F) the value at pixel (0, 0)'s
    centre, per column and per row of functions that are positive inside; ``depths`` (3, F) the same of the depth as a
    share 0..1 of what there is.
    """

    rows: Int64Array
    bounds: Float64Array
    depths: Float64Array

    @classmethod
    def of(cls, faces: Faces, view: View) -> _Planes:
        """The faces' functions; those seen edge-on have no rows."""
        corner = view.project(faces.corners)
        axes = np.array([[1.0, -1.0, 1.0]]) / [[view.pixel, view.pixel, 1.0]]
        a, b = (faces.edges_a @ view.axes.T) * axes, (faces.edges_b @ view.axes.T) * axes
        area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            du, dv = np.stack([b[:, 1], -b[:, 0]]) / area, np.stack([-a[:, 1], a[:, 0]]) / area
            offset = 0.5 - corner[:, :2].T
            u = np.stack([(du * offset).sum(axis=0), *du])
            v = np.stack([(dv * offset).sum(axis=0), *dv])
            depth = a[:, 2] * u + b[:, 2] * v
        one = np.zeros_like(u)
        one[0] = 1.0
        bounds = np.stack([u, v, one - u - v, one] if faces.is_triangle else [u, v, one - u, one - v])
        depth[0] += corner[:, 2]
        extent = [0.0 * a[:, 1], a[:, 1], b[:, 1]] + ([] if faces.is_triangle else [a[:, 1] + b[:, 1]])
        low = np.ceil(corner[:, 1] + np.min(extent, axis=0) - 0.5)
        high = np.ceil(corner[:, 1] + np.max(extent, axis=0) - 0.5)
        flat = ~np.isfinite(bounds).all(axis=(0, 1)) | (np.abs(area) < 1e-9)
        rows = np.clip(np.column_stack([low, np.where(flat, low, high)]), 0, view.height).astype(np.int64)
        nearest = np.minimum(np.minimum(a[:, 2], 0) + np.minimum(b[:, 2], 0), 0) + corner[:, 2]
        farthest = np.maximum(a[:, 2], 0) + np.maximum(b[:, 2], 0) + corner[:, 2]
        least, most = nearest.min(initial=np.inf), farthest.max(initial=-np.inf)
        depth[0] -= least
        return cls(rows, np.where(flat, 0.0, bounds), np.where(flat, 0.0, depth) / max(most - least, 1e-9))

    def pieces(self, rows: slice, width: int) -> UInt64Array:
        """Sorted keys of all pieces in some rows: pixel of the band, depth, face."""
        low, high = np.clip(self.rows, rows.start, rows.stop).T
        face = np.repeat(np.arange(len(low)), high - low)
        row = np.arange(len(face)) - np.repeat(np.cumsum(high - low) - high, high - low)
        start, stop = self._columns(face, row, width)
        count = np.maximum(stop - start, 0)
        line = np.repeat(np.arange(len(face)), count)
        column = np.arange(len(line)) - np.repeat(np.cumsum(count) - count - start, count)
        depth = self.depths[0, face] + self.depths[2, face] * row
        place = depth[line] + self.depths[1, face][line] * column
        steps = np.clip(place * ((1 << _DEPTH_BITS) - 1), 0, (1 << _DEPTH_BITS) - 1).astype(np.uint64)
        pixel = ((row - rows.start) * width)[line] + column
        keys: UInt64Array = pixel.astype(np.uint64) << np.uint64(_FACE_BITS + _DEPTH_BITS)
        keys |= steps << np.uint64(_FACE_BITS)
        keys |= face[line].astype(np.uint64)
        keys.sort()
        return keys

    def _columns(self, face: Int64Array, row: Int64Array, width: int) -> tuple[Int64Array, Int64Array]:
        """The first column of each face in a row, and the one after its last."""
        start, stop = np.zeros(len(face)), np.full(len(face), float(width))
        for value, per_column, per_row in self.bounds:
            at_zero, slope = value[face] + per_row[face] * row, per_column[face]
            with np.errstate(divide="ignore", invalid="ignore"):
                # Half-open on both sides, so that faces that share an edge share no pixel.
                crossing = np.ceil(-at_zero / slope)
            rising, falling = slope > 1e-12, slope < -1e-12
            np.maximum(start, crossing, out=start, where=rising)
            np.minimum(stop, crossing, out=stop, where=falling)
            stop[~rising & ~falling & (at_zero < 0)] = 0
        return start.astype(np.int64), np.maximum(stop, start).astype(np.int64)
