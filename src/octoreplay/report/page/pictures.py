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
from octoreplay.report.map_part import MapPart
from octoreplay.report.map_view import Overlay, cube_faces, draw, opacities, overlay, view_of
from octoreplay.report.page.team_map import together
from octoreplay.result import Result

_SIZE = (900, 560)
_VIEWS = ((-60.0, "seen from the south-east"), (120.0, "seen from the north-west"))
_MOST_CUBES = 400_000
"""Largest number of cubes in a picture."""


def pictures(result: Result, max_depth: int | None = None) -> str:
    """Return pictures of the robots' last maps as HTML figures, transparent where the robots differ.

    ``max_depth`` is as in ``StoredMap.coarsened``. Returns an empty text for a result without maps or occupied cells,
    and a sentence for a map that is too large.
    """
    stored_ids = [robot_id for robot_id in result.robots if result.stored_ticks(robot_id)]
    if not stored_ids:
        return "<p>The result holds no map.</p>"
    overlays: list[Overlay] = []
    num_cells = 0
    for part in MapPart(max_depth=max_depth).parts(result):
        stored = {name: part.map(result, name) for name in stored_ids}
        names = together(stored)
        cells = overlay([stored[name] for name in names])
        num_cells += len(cells.labels)
        # No more cells are kept than pictures show.
        overlays = [*overlays, cells] if num_cells <= _MOST_CUBES else []
    if num_cells > _MOST_CUBES:
        return f"<p>No pictures: the map has {num_cells:,} occupied cells.</p>"
    if not num_cells:
        return "<p>The maps hold no occupied cell.</p>"
    return _figures(result, names, Overlay.joined(overlays))


def _figures(result: Result, robot_ids: Sequence[str], cells: Overlay) -> str:
    """Figures of the overlay of the maps of some robots."""
    palette = np.concatenate([np.array([FREE_COLOR], dtype=np.uint8), result.class_table.colors])
    largest = float(cells.deviations.max(initial=0.0))
    faces = cube_faces(
        cells.centers, cells.resolution, palette[cells.labels], opacities(cells.deviations, max(largest, 1e-3))
    )
    names = escaped(", ".join(robot_ids))
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
