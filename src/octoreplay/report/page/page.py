"""One HTML file that shows a result: 3-D view over log time, charts and tables."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from octoreplay._version import __version__
from octoreplay.errors import InputError, escaped
from octoreplay.io.output_file import write_whole
from octoreplay.report.cell_colors import CONTRADICTION_COLORS, robot_color
from octoreplay.report.page import page_tables, pictures, series
from octoreplay.report.page.columns import Columns
from octoreplay.report.page.layers import Layers
from octoreplay.report.page.tile_pool import TilePool
from octoreplay.report.page.tiles import NO_TILE
from octoreplay.result import Result, open_result

DEFAULT_MAX_BYTES = 25_000_000
"""Default of the largest size of a page [byte]."""
_SCRIPTS = (
    "data.js", "tiles.js", "mesh.js", "camera.js", "renderer.js", "charts.js", "picked.js", "main.js",
)  # fmt: skip
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; connect-src 'self'"
"""Content security policy: the page loads nothing but the tiles from the server that sent it."""
_MOST_LEAVES = 120_000_000
"""Largest number of leaves of all maps and ticks that are put into tiles; takes about a minute."""
_LEVELS = ((0, 0), (0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (3, 4), (4, 5))
"""Finest levels of the team's map and of all other maps, from the largest page to the smallest."""


def write_page(
    result_path: Path | str, output: Path | str, *, max_bytes: int = DEFAULT_MAX_BYTES, max_depth: int | None = None
) -> int:
    """Write the page of a result to a file and return its size [byte].

    Parameters
    ----------
    result_path, output : Path or str
        Result file, and HTML file to write.
    max_bytes : int
        Size that the page should not exceed [byte]. Fine levels of the maps are left out where it would; the page says
        so. The coarsest levels, charts and tables are always there.
    max_depth : int, optional
        Depth of the finest cells of the maps, from 1 to 19 (``StoredMap.coarsened``); all cells by default.

    Raises
    ------
    ConfigError
        ``max_depth`` is no depth.
    InputError
        The result cannot be read, or holds no tick.
    OutputError
        The file cannot be written, or the temporary file of the maps' tiles.
    """
    with open_result(result_path) as result:
        text = page_of(result, max_bytes, max_depth)
    content = text.encode()
    write_whole(Path(output), content)
    return len(content)


def page_of(result: Result, max_bytes: int = DEFAULT_MAX_BYTES, max_depth: int | None = None) -> str:
    """Return the page of a result as HTML. Raises as ``write_page``."""
    with PageContents(result, max_depth) as contents:
        room = max_bytes - len(contents.html(b"").encode())
        for team_level, robot_level in _LEVELS:
            contents.layers.keep_levels(team_level, robot_level)
            columns = Columns(None if (team_level, robot_level) == _LEVELS[-1] else max(room, 0) * 3 // 4)
            header = contents.header(columns)
            block = columns.compressed()
            if not columns.is_full and len(header) + 4 * len(block) / 3 <= room:
                break
        return contents.html(block, header)


class PageContents:
    """Everything that a page shows of a result; a context manager.

    Of a result in tiles it reads one tile after the other. ``max_depth`` is as in ``StoredMap.coarsened``. Raises
    InputError where the result holds no tick, and OutputError where the temporary file of the tiles cannot be written.
    """

    def __init__(self, result: Result, max_depth: int | None = None) -> None:
        if not result.metrics:
            raise InputError(f"{result.path}: holds no tick; the run was interrupted before its first one")
        self.result = result
        self.times = series.times(result)
        stored = stored_ticks(result)
        self.num_stored = len(stored)
        self.pictures = pictures.pictures(result, max_depth)
        self.layers = Layers(result, chosen_ticks(result, stored), max_depth)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.layers.__exit__(*error)

    def header(self, columns: Columns) -> str:
        """Return the header of a page that holds all tiles as JSON, and add its arrays to ``columns``."""
        used = {name: self.layers.contents_in_use(name) for name in self.layers.store.pools}
        pools = {
            name: {column: columns.add(pool.column(column, used[name])) for column in pool.names}
            for name, pool in self.layers.store.pools.items()
        }
        return self._header(columns, pools, used)

    def served_header(self, columns: Columns) -> tuple[str, Mapping[str, TilePool]]:
        """Return the header of a page whose tiles a server sends, and the pools of these tiles by name."""
        return self._header(columns, None, {}), self.layers.store.pools

    def _header(
        self, columns: Columns, pools: Mapping[str, Any] | None, used: Mapping[str, npt.NDArray[np.uint32]]
    ) -> str:
        """Header with the places of the pools, None where a server sends their tiles."""
        result, layers = self.result, self.layers
        # Maps of tick 0 belong to the time before the first metrics.
        stored_rows = np.searchsorted([tick.tick for tick in result.metrics], layers.ticks).astype(np.uint32)
        settling = [tick.settling for tick in result.metrics]
        bounds = layers.bounds
        low, high = (bounds.low[2], bounds.high[2]) if np.isfinite(bounds.low[2]) else (-1.0, 1.0)
        description = {
            "served": pools is None,
            "resolution": layers.resolution,
            "robots": [
                {"id": escaped(name), "color": list(robot_color(index))} for index, name in enumerate(result.robots)
            ],
            "classes": [
                {"id": entry.class_id, "name": escaped(entry.name), "color": list(entry.color)}
                for entry in result.class_table.classes
            ],
            "times": columns.add(self.times),
            "settlingFrom": float(self.times[max(settling.index(True) - 1, 0)]) if any(settling) else None,
            "storedRows": columns.add(stored_rows),
            "heights": [float(low), float(high)],
            "box": [bounds.near.tolist(), bounds.far.tolist()],
            "contradictions": [
                {"name": name, "color": list(color)} for _, (name, color) in sorted(CONTRADICTION_COLORS.items())
            ],
            "masks": [_robots_in(mask, len(result.robots)) for mask in layers.store.masks.values],
            "leastProbability": 1.0 / (result.class_table.num_classes + 1),
            "largestDisagreement": layers.largest_disagreement,
            "hasFirst": layers.evidence.has_history,
            "hasEvidence": bool(layers.evidence.ticks),
            "evidenceNote": self._evidence_note(),
            "layers": [
                {"name": escaped(layer.name), "robot": escaped(layer.robot_id), "kind": layer.kind,
                 "title": layer.title, "tiles": columns.add_all(_renumbered(layer.columns(), used))}
                for layer in layers.layers
            ],
            "pools": {} if pools is None else pools,
            "charts": series.charts(result, columns),
            "links": series.links(result, columns),
            "poses": series.poses(result, columns),
            "frames": series.frames(result, columns),
        }  # fmt: skip
        return json.dumps(description, ensure_ascii=True, allow_nan=False).replace("<", "\\u003c")

    def html(self, block: bytes, header: str = "{}") -> str:
        """Return the page with a header and its arrays."""
        result = self.result
        parts = {
            "policy": _POLICY,
            "title": escape(escaped(result.path.name)),
            "verdict": page_tables.verdict(result),
            "style": _asset("style.css"),
            "pictures": self.pictures,
            "tables": page_tables.tables(result),
            "footer": escape(self._footer()),
            "header": header,
            "columns": base64.b64encode(block).decode(),
            "script": "\n".join(map(_asset, _SCRIPTS)),
        }
        pieces = _asset("page.html").split("@")
        return "".join(parts.get(piece, piece) if index % 2 else piece for index, piece in enumerate(pieces))

    def _evidence_note(self) -> str:
        """Sentence on the evidence that the colours of the team's map show."""
        if not self.layers.evidence.ticks or self.layers.evidence.has_history:
            return ""
        return "The scans up to the end of the run; store evidence with --evidence-every to see it over time."

    def _footer(self) -> str:
        """Sentences on what the page leaves out, and the version."""
        sentences = []
        for is_team, name in ((True, "the team's map"), (False, "the robots' maps")):
            edge = self.layers.resolution * 2 ** self.layers.finest_level(is_team=is_team)
            if edge > self.result.config.map.resolution:
                sentences.append(f"The finest cells of {name} on this page have an edge of {edge:g} m.")
        if len(self.layers.ticks) < self.num_stored:
            sentences.append(f"The page has {len(self.layers.ticks)} of {self.num_stored} stored maps of each robot.")
        if sentences:
            sentences.append("octoreplay view shows all cells.")
        return " ".join([*sentences, f"octoreplay {__version__}, WebGL 2, no third-party code."])


def stored_ticks(result: Result) -> list[int]:
    """Return all ticks at which maps are stored, up to the last one with metrics."""
    stored = {tick for robot_id in result.robots for tick in result.stored_ticks(robot_id)}
    return sorted(tick for tick in stored if tick <= result.metrics[-1].tick)


def chosen_ticks(result: Result, stored: Sequence[int]) -> list[int]:
    """Return as many stored ticks as have at most _MOST_LEAVES leaves in all maps, evenly spaced, with the last one."""
    if not stored:
        return []
    last = result.metrics[-1]
    num_leaves = 2 * sum(robot.num_leaves for robot in last.robots) + 1
    count = min(len(stored), max(2, _MOST_LEAVES // num_leaves))
    places = np.unique(np.rint(np.linspace(0, len(stored) - 1, count)).astype(int))
    return [stored[place] for place in places.tolist()]


def _renumbered(
    columns: Mapping[str, npt.NDArray[Any]], used: Mapping[str, npt.NDArray[np.uint32]]
) -> dict[str, npt.NDArray[Any]]:
    """Columns of a layer with the new indices of contents: their places in ``used``."""
    changed = dict(columns)
    for name, wanted in used.items():
        is_named = columns[name] != NO_TILE
        order = np.argsort(wanted)
        changed[name] = np.full(len(is_named), NO_TILE, np.uint32)
        changed[name][is_named] = order[np.searchsorted(wanted, columns[name][is_named], sorter=order)]
    return changed


def _robots_in(mask: int, num_robots: int) -> list[int]:
    """Indices of the robots in a mask."""
    return [index for index in range(num_robots) if mask >> min(index, 63) & 1]


def _asset(name: str) -> str:
    """Text of a file of the page."""
    return (resources.files(__package__) / "assets" / name).read_text(encoding="utf-8")
