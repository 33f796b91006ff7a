"""Oblique bird's-eye pictures of maps: shaded cubes or triangles with transparency, drawn with NumPy only.

The camera is orthographic. Every face is cut into pixels row by row. The pieces of a pixel are sorted by depth and
blended front to back, so that any number of transparent cells may lie behind each other. The same drawing from the
direction of the sun gives the light that reaches each face. The same input gives the same picture.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octoreplay.log_odds import best_labels
from octoreplay.mapping.octree import codes_to_keys, keys_to_codes
from octoreplay.records import Float64Array, Int64Array, UInt8Array, UInt64Array
from octoreplay.stored_map import StoredMap

BACKGROUND = (236, 239, 243)
"""Colour of the background; not white, so that pale and transparent cells differ."""

_SUN = (0.6, 0.45, 0.75)
"""Direction to the sun relative to the view: right, back, up."""
_AMBIENT, _SKY, _SUNLIGHT = 0.56, 0.06, 0.56
_SUN_PIXELS = 8192
"""Largest width and height of the picture from the sun in pixels."""
_BAND_PIXELS = 1 << 20
_FACE_BITS, _DEPTH_BITS = 22, 20
_MAX_FACES = 1 << _FACE_BITS

_DIRECTIONS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


@dataclass(frozen=True)
class View:
    """Orthographic camera that looks obliquely down.

    Attributes
    ----------
    azimuth : float
        Direction of view in radians, counter-clockwise from x.
    elevation : float
        Angle of the direction of view below the horizon in radians.
    target : tuple of float
        Point (x, y, z) in the middle of the picture in metres.
    pixel : float
        Edge of a pixel in metres.
    width, height : int
        Size of the picture in pixels.
    """

    azimuth: float
    elevation: float
    target: tuple[float, float, float]
    pixel: float
    width: int
    height: int

    @property
    def axes(self) -> Float64Array:
        """Rows (3, 3): right and up in the picture, and the direction of view."""
        cos_a, sin_a = math.cos(self.azimuth), math.sin(self.azimuth)
        cos_e, sin_e = math.cos(self.elevation), math.sin(self.elevation)
        return np.array(
            [[sin_a, -cos_a, 0.0], [cos_a * sin_e, sin_a * sin_e, cos_e], [cos_a * cos_e, sin_a * cos_e, -sin_e]]
        )

    def project(self, points: npt.ArrayLike) -> Float64Array:
        """Return column and row in pixels from the upper left and depth in metres, (..., 3), of points (..., 3)."""
        seen = (np.asarray(points, np.float64) - self.target) @ self.axes.T
        half = (self.width / 2, self.height / 2)
        return np.stack(
            [seen[..., 0] / self.pixel + half[0], half[1] - seen[..., 1] / self.pixel, seen[..., 2]], axis=-1
        )

    def scaled(self, factor: int) -> View:
        """Return the same view with pixels ``factor`` times finer."""
        return View(
            self.azimuth, self.elevation, self.target, self.pixel / factor, self.width * factor, self.height * factor
        )


def view_of(points: npt.ArrayLike, azimuth: float, elevation: float, width: int, height: int) -> View:
    """Return the closest view of points (P, 3) in metres that contains all of them, centred in the picture."""
    points = np.asarray(points, np.float64)
    turned = View(azimuth, elevation, (0.0, 0.0, 0.0), 1.0, 0, 0)
    seen = points @ turned.axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    pixel = max(float((high[0] - low[0]) / width), float((high[1] - low[1]) / height), 1e-6)
    x, y, z = ((low + high) / 2 @ turned.axes).tolist()
    return View(azimuth, elevation, (x, y, z), pixel, width, height)


class Faces(NamedTuple):
    """Parallelograms or triangles in space.

    Attributes
    ----------
    corners, edges_a, edges_b : (F, 3) float64
        A corner and the two edges from it in metres.
    normals : (F, 3) float64
        Unit vectors. Parallelograms are visible from their front only, triangles from both sides.
    colors : (F, 3) float64
        Colours from 0 to 255.
    opacities : (F,) float64
        Opacities from 0 to 1.
    is_triangle : bool
        True where the faces are triangles of the corner and the ends of the two edges.
    """

    corners: Float64Array
    edges_a: Float64Array
    edges_b: Float64Array
    normals: Float64Array
    colors: Float64Array
    opacities: Float64Array
    is_triangle: bool

    def taken(self, rows: Int64Array) -> Faces:
        """Return the faces with these indices."""
        return Faces(
            self.corners[rows], self.edges_a[rows], self.edges_b[rows], self.normals[rows], self.colors[rows],
            self.opacities[rows], self.is_triangle,
        )  # fmt: skip


class Overlay(NamedTuple):
    """Overlay of several robots' maps: finest cells that the mean of the log-odds calls occupied, in Morton order.

    Attributes
    ----------
    centers : (M, 3) float64
        Centres in metres.
    labels : (M,) uint8
        Most probable class of the mean.
    deviations : (M,) float64
        Largest ||h_i - h_j|| over the pairs of robots; an unknown cell counts as the prior.
    resolution : float
        Edge of a cell in metres.
    """

    centers: Float64Array
    labels: UInt8Array
    deviations: Float64Array
    resolution: float

    @classmethod
    def joined(cls, parts: Sequence[Overlay]) -> Overlay:
        """Return the overlay of maps, at least one, from those of parts without common cells."""
        centers = np.concatenate([part.centers for part in parts])
        resolution = parts[0].resolution
        order = np.argsort(keys_to_codes(np.floor(centers / resolution).astype(np.int64)), kind="stable")
        labels = np.concatenate([part.labels for part in parts])
        deviations = np.concatenate([part.deviations for part in parts])
        return cls(centers[order], labels[order], deviations[order], resolution)


def overlay(maps: Sequence[StoredMap]) -> Overlay:
    """Return the overlay of the maps of one team at one time."""
    spans = [stored.octree.spans() for stored in maps]
    prior = np.float32(maps[0].prior)
    # A mean above zero needs a robot with a value above zero; all other cells are free.
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
    """Return opacities 1 - d / ``largest``, at least ``least``, of cells with deviations d (M,)."""
    shares = deviations / largest if largest > 0 else np.zeros(len(deviations))
    return np.clip(1.0 - shares, least, 1.0)


def cube_faces(centers: Float64Array, edge: float, colors: UInt8Array, opacities: Float64Array) -> Faces:
    """Return the faces of cubes, without faces between two cubes.

    The centres (M, 3) are on a grid with this edge, both in metres. ``colors`` (M, 3) are uint8, ``opacities`` (M,)
    from 0 to 1.
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
    """Return opaque triangles with corners (T, 3, 3) in metres and colours (T, 3) uint8, visible from both sides."""
    edges_a, edges_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(edges_a, edges_b)
    lengths = np.linalg.norm(normals, axis=1)
    keep = lengths > 0
    return Faces(
        corners[keep, 0], edges_a[keep], edges_b[keep], normals[keep] / lengths[keep, None],
        colors[keep].astype(np.float64), np.ones(int(keep.sum())), is_triangle=True,
    )  # fmt: skip


def draw(faces: Faces, view: View, supersampling: int = 2) -> UInt8Array:
    """Return the picture (height, width, 3) uint8 of faces over the background.

    Every pixel is the mean of ``supersampling`` squared finer pixels. Raises ValueError for more than 4 million faces.
    """
    if len(faces.corners) > _MAX_FACES:
        raise ValueError(f"faces: {len(faces.corners)} are more than the {_MAX_FACES} that can be drawn")
    lit = faces._replace(colors=faces.colors * _light(faces, view)[:, None])
    fine = view.scaled(supersampling)
    picture = np.empty((view.height, view.width, 3), np.uint8)
    for rows, pieces in _bands(lit.taken(_facing(lit, view.axes[2])), fine, supersampling):
        blended = _blended(pieces, (rows.stop - rows.start) * fine.width)
        blended = blended.reshape(-1, supersampling, view.width, supersampling, 3).mean(axis=(1, 3))
        picture[rows.start // supersampling : rows.stop // supersampling] = np.rint(np.clip(blended, 0, 255))
    return picture


def _packed(keys: Int64Array) -> Int64Array:
    """One integer for each key (M, 3), distinct for cells and their neighbours."""
    packed: Int64Array = (keys + (1 << 19)) @ np.array([1 << 40, 1 << 20, 1], dtype=np.int64)
    return packed


def _facing(faces: Faces, direction: Float64Array) -> Int64Array:
    """Indices of the faces that are visible in a direction of view; triangles are visible from both sides."""
    if faces.is_triangle:
        return np.arange(len(faces.corners))
    return np.flatnonzero(faces.normals @ direction < -1e-9)


def _light(faces: Faces, view: View) -> Float64Array:
    """Brightness (F,) of each face: light of the sky, and of the sun where it reaches the face."""
    right, _, ahead = view.axes
    level = np.array([ahead[0], ahead[1], 0.0]) / max(math.hypot(ahead[0], ahead[1]), 1e-9)
    sun = _SUN[0] * right - _SUN[1] * level + (0.0, 0.0, _SUN[2])
    sun /= np.linalg.norm(sun)
    normals = faces.normals
    if faces.is_triangle:
        normals = np.where((normals @ ahead > 0)[:, None], -normals, normals)
    light: Float64Array = _AMBIENT + _SKY * normals[:, 2]
    light += _SUNLIGHT * np.maximum(normals @ sun, 0.0) * _sunlit_shares(faces, sun, view.pixel)
    return light


def _sunlit_shares(faces: Faces, sun: Float64Array, pixel: float) -> Float64Array:
    """Share (F,) of the sun's light that reaches each face; 1 for faces without a pixel in the picture from the sun."""
    chosen = _facing(faces, -sun)
    view = View(math.atan2(-sun[1], -sun[0]), math.asin(sun[2]), (0.0, 0.0, 0.0), pixel, 0, 0)
    ends = faces.corners + np.stack([0 * faces.edges_a, faces.edges_a, faces.edges_b, faces.edges_a + faces.edges_b])
    seen = view.project(ends).reshape(-1, 3)
    low, high = seen.min(axis=0, initial=0.0), seen.max(axis=0, initial=0.0)
    width, height = (max(1, min(_SUN_PIXELS, 2 * math.ceil(max(-low[k], high[k])))) for k in range(2))
    view = View(view.azimuth, view.elevation, view.target, pixel, width, height)
    shares, counts = np.zeros(len(chosen)), np.zeros(len(chosen))
    for _, pieces in _bands(faces.taken(chosen), view, 1):
        shares += np.bincount(pieces.faces, pieces.through, minlength=len(chosen))
        counts += np.bincount(pieces.faces, minlength=len(chosen))
    sunlit = np.ones(len(faces.corners))
    sunlit[chosen[counts > 0]] = shares[counts > 0] / counts[counts > 0]
    return sunlit


class _Pieces(NamedTuple):
    """Pieces of faces in one band of a picture, sorted by pixel and then by depth.

    Attributes
    ----------
    pixels, faces : (P,) int64
        Pixel of the band and index of the face.
    colors : (P, 3) float64
        Colours of the faces.
    alphas, through : (P,) float64
        Opacities, and shares of the light that pass all nearer pieces of the pixel.
    """

    pixels: Int64Array
    faces: Int64Array
    colors: Float64Array
    alphas: Float64Array
    through: Float64Array


def _bands(faces: Faces, view: View, multiple: int) -> Iterator[tuple[slice, _Pieces]]:
    """Yield bands of rows, each with a multiple of ``multiple`` rows, and their pieces."""
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
    """Share of light (P,) that passes the nearer pieces of the same pixel: the product of 1 - alpha."""
    passed = np.concatenate([[0.0], np.cumsum(np.log(np.maximum(1.0 - alphas, 1e-12)))])[:-1]
    starts = np.flatnonzero(np.diff(pixels, prepend=-1))
    lengths = np.diff(starts, append=len(pixels))
    through: Float64Array = np.exp(passed - np.repeat(passed[starts], lengths))
    return through


def _blended(pieces: _Pieces, num_pixels: int) -> Float64Array:
    """Colours (num_pixels, 3) of a band over the background."""
    weights = pieces.through * pieces.alphas
    rest = 1.0 - np.bincount(pieces.pixels, weights, minlength=num_pixels)
    colors: Float64Array = np.outer(rest, np.asarray(BACKGROUND, np.float64))
    for channel in range(3):
        colors[:, channel] += np.bincount(pieces.pixels, weights * pieces.colors[:, channel], minlength=num_pixels)
    return colors


class _Planes(NamedTuple):
    """Projected faces as linear functions of column and row in a picture.

    A linear function has three values: at the centre of pixel (0, 0), per column and per row.

    Attributes
    ----------
    rows : (F, 2) int64
        First row, and the row after the last.
    bounds : (4, 3, F) float64
        Functions that are positive inside the face.
    depths : (3, F) float64
        Depth as a share 0..1 of the range of all faces.
    """

    rows: Int64Array
    bounds: Float64Array
    depths: Float64Array

    @classmethod
    def of(cls, faces: Faces, view: View) -> _Planes:
        """Return the functions of faces; a face that is seen edge-on has no rows."""
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
        """Return the sorted keys of all pieces in some rows, packed from pixel of the band, depth and face."""
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
        """First column of each face in a row, and the column after the last."""
        start, stop = np.zeros(len(face)), np.full(len(face), float(width))
        for value, per_column, per_row in self.bounds:
            at_zero, slope = value[face] + per_row[face] * row, per_column[face]
            with np.errstate(divide="ignore", invalid="ignore"):
                # Half-open intervals, so that faces with a common edge have no common pixel.
                crossing = np.ceil(-at_zero / slope)
            rising, falling = slope > 1e-12, slope < -1e-12
            np.maximum(start, crossing, out=start, where=rising)
            np.minimum(stop, crossing, out=stop, where=falling)
            stop[~rising & ~falling & (at_zero < 0)] = 0
        return start.astype(np.int64), np.maximum(stop, start).astype(np.int64)
