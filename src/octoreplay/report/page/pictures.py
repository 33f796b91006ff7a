"""Pictures of a result's last maps, for browsers without WebGL and for print."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from html import escape

import numpy as np

from octoreplay.errors import escaped
from octoreplay.records import UInt8Array
from octoreplay.report.cell_colors import FREE_COLOR
from octoreplay.report.map_view import cube_faces, draw, opacities, overlay, view_of
from octoreplay.report.page.team_map import together
from octoreplay.result import Result
from octoreplay.stored_map import StoredMap

_SIZE = (900, 560)
_VIEWS = ((-60.0, "seen from the south-east"), (120.0, "seen from the north-west"))
_MOST_CUBES = 400_000
"""Largest number of cubes in a picture."""


def pictures(result: Result, max_depth: int | None = None) -> str:
    """Return pictures of the robots' last maps as HTML figures, transparent where the robots differ.

    ``max_depth`` is as in ``StoredMap.coarsened``. Returns an empty text for a result without maps or occupied cells,
    and a sentence for a map that is too large.
    """
    stored = {name: result.map(name).coarsened(max_depth) for name in result.robots if result.stored_ticks(name)}
    maps = [stored[name] for name in together(stored)]
    if not maps:
        return "<p>The result holds no map.</p>"
    return _figures(result, maps)


def _figures(result: Result, maps: Sequence[StoredMap]) -> str:
    """Figures of the overlay of maps with a common frame."""
    cells = overlay(maps)
    if not len(cells.labels):
        return "<p>The maps hold no occupied cell.</p>"
    if len(cells.labels) > _MOST_CUBES:
        return f"<p>No pictures: the map has {len(cells.labels):,} occupied cells.</p>"
    palette = np.concatenate([np.array([FREE_COLOR], dtype=np.uint8), result.class_table.colors])
    largest = float(cells.deviations.max(initial=0.0))
    faces = cube_faces(
        cells.centers, cells.resolution, palette[cells.labels], opacities(cells.deviations, max(largest, 1e-3))
    )
    names = escaped(", ".join(stored.robot_id for stored in maps))
    found = []
    for azimuth, words in _VIEWS:
        view = view_of(cells.centers, math.radians(azimuth), math.radians(35), *_SIZE)
        title = f"Maps of {names} at the end of the run, {words}"
        found.append(_figure(draw(faces, view), title))
    return "".join(found)


def _figure(picture: UInt8Array, title: str) -> str:
    """Picture as a data URL in a figure."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).quantize(128).save(file, "PNG", optimize=True)
    data = base64.b64encode(file.getvalue()).decode()
    image = f'<img alt="{escape(title)}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{escape(title)}</figcaption></figure>"
