"""Encoder of binary glTF 2.0 files (GLB): a mesh of rectangles with a colour each.

The format is that of the specification "glTF 2.0" (Khronos Group). Its y axis points up and its vertex colours are
linear, so that coordinates are turned and colours are converted from sRGB.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from octoreplay.records import Float64Array, UInt8Array

_FLOAT, _UNSIGNED_SHORT, _UNSIGNED_INT = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963
_TRIANGLES = (0, 1, 2, 0, 2, 3)


def mesh_file(rectangles: Float64Array, shades: UInt8Array, comments: Sequence[str] = ()) -> bytes:
    """Return a GLB file of rectangles; a point (x, y, z) with z up has the coordinates (x, z, -y).

    ``rectangles`` (Q, 4, 3) are the corners [m], counter-clockwise as seen from outside, ``shades`` (Q, 3) their sRGB
    colours. Each rectangle has four vertices of its own, and two triangles. Colours are normalised 16-bit numbers.
    ``comments`` are in the field ``extras`` of the asset.
    """
    corners = rectangles.reshape(-1, 3)
    positions = np.stack([corners[:, 0], corners[:, 2], -corners[:, 1]], axis=1).astype("<f4")
    colors = np.full((len(positions), 4), 65535, "<u2")
    colors[:, :3] = np.repeat(_linear(shades), 4, axis=0)
    indices = (4 * np.arange(len(rectangles), dtype="<u4")[:, None] + np.array(_TRIANGLES, "<u4")).astype("<u4")
    parts = [positions.tobytes(), colors.tobytes(), indices.tobytes()]
    views, start = [], 0
    for part, target in zip(parts, (_VERTICES, _VERTICES, _INDICES), strict=True):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": target})
        start += len(part)
    content = {
        "asset": {"version": "2.0", "generator": "octoreplay", "extras": {"comments": list(comments)}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "map"}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0, "mode": 4}]}
        ],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": len(positions), "type": "VEC3",
             "min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()},
            {"bufferView": 1, "componentType": _UNSIGNED_SHORT, "normalized": True, "count": len(colors),
             "type": "VEC4"},
            {"bufferView": 2, "componentType": _UNSIGNED_INT, "count": indices.size, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }  # fmt: skip
    return _container(json.dumps(content, separators=(",", ":")).encode(), b"".join(parts))


def _linear(colors: UInt8Array) -> npt.NDArray[np.uint16]:
    """Colours (n, 3) of sRGB as linear 16-bit numbers (IEC 61966-2-1)."""
    share = colors.astype(np.float64) / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.rint(linear * 65535), np.uint16)


def _container(text: bytes, data: bytes) -> bytes:
    """GLB file of a JSON and a binary chunk, both padded to multiples of four bytes."""
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data))
    return header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
