"""Slow reader of the page of a result: its header, arrays and maps, from docs/report-page.md alone."""

from __future__ import annotations

import base64
import gzip
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

_NO_TILE = 0xFFFFFFFF
_TYPES = {"Uint8Array": "u1", "Uint16Array": "<u2", "Uint32Array": "<u4", "Int16Array": "<i2", "Int32Array": "<i4",
          "Float32Array": "<f4", "Float64Array": "<f8"}  # fmt: skip
Cell = tuple[int, int, int]


@dataclass
class Cube:
    """Values of a cube by the names of the columns, and its edge in cells of its level."""

    edge: int
    values: dict[str, int]


class Page:
    """Contents of a page."""

    def __init__(self, path: Path) -> None:
        self.text = path.read_text(encoding="utf-8")
        self.block = gzip.decompress(base64.b64decode(self._script("columns")))
        self.header: dict[str, Any] = json.loads(self._script("header"))

    def _script(self, name: str) -> str:
        found = re.search(rf'<script id="{name}" type="[^"]*">(.*?)</script>', self.text, re.S)
        assert found is not None
        return found[1]

    def array(self, place: dict[str, Any]) -> npt.NDArray[Any]:
        """Array at a place of the block."""
        kind = np.dtype(_TYPES[place["type"]])
        size = place["count"] * kind.itemsize
        raw = np.frombuffer(self.block, np.uint8, size, place["offset"]).reshape(kind.itemsize, -1)
        return np.frombuffer(np.ascontiguousarray(raw.T).tobytes(), kind)

    def columns(self, places: dict[str, Any]) -> dict[str, npt.NDArray[Any]]:
        """Arrays by name."""
        return {name: self.array(place) for name, place in places.items()}

    def layer(self, name: str) -> dict[str, Any]:
        """Description of a layer."""
        return next(layer for layer in self.header["layers"] if layer["name"] == name)

    def contents(self, pool: str, index: int) -> dict[str, npt.NDArray[Any]]:
        """Columns of one contents of a pool."""
        columns = self.columns(self.header["pools"][pool])
        rows = slice(*columns.pop("starts")[index : index + 2])
        return {name: values[rows] for name, values in columns.items()}

    def map(self, name: str, index: int, level: int = 0) -> tuple[dict[Cell, Cube], set[Cell]]:
        """Cubes by their first cell, and free cells, of a layer at the stored tick with an index."""
        tiles = self.columns(self.layer(name)["tiles"])
        latest: dict[Cell, int] = {}
        for row in range(len(tiles["levels"])):
            if tiles["levels"][row] == level and tiles["ticks"][row] <= index:
                latest[tuple(tiles["places"][3 * row : 3 * row + 3].tolist())] = row
        cubes: dict[Cell, Cube] = {}
        free: set[Cell] = set()
        for place, row in latest.items():
            if tiles["cubes"][row] != _NO_TILE:
                columns = self.contents("cubes", tiles["cubes"][row])
                if tiles["team"][row] != _NO_TILE:
                    columns |= self.contents("team", tiles["team"][row])
                for number, code in enumerate(np.cumsum(columns["steps"]).tolist()):
                    values = {
                        key: int(column[number]) for key, column in columns.items() if key not in ("steps", "size")
                    }
                    cubes[_cell(place, code)] = Cube(1 << int(columns["size"][number]), values)
            if tiles["free"][row] != _NO_TILE:
                columns = self.contents("free", tiles["free"][row])
                for start, length in zip(np.cumsum(columns["gaps"]), columns["lengths"], strict=True):
                    free |= {_cell(place, code) for code in range(int(start), int(start) + int(length) + 1)}
        return cubes, free


def _cell(place: Cell, code: int) -> Cell:
    """Cell of a Morton code in a tile, whose coordinates are interleaved: x, y, z from the lowest bit."""
    x, y, z = (sum((code >> (3 * bit + axis) & 1) << bit for bit in range(5)) + 32 * place[axis] for axis in range(3))
    return x, y, z
