"""Header of a TIFF image, read without a library: Pillow and OpenCV write warnings about damaged files themselves.

TIFF 6.0: https://www.itu.int/itudoc/itu-t/com16/tiff-fx/docs/tiff6.pdf
"""

from __future__ import annotations

import struct
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import IO

MAGICS = (b"II*\0", b"MM\0*")
"""First bytes of little-endian and big-endian files."""

_WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC, _SAMPLES, _FORMAT = 256, 257, 258, 259, 262, 277, 339
_DEFAULTS = {_BITS: 1, _COMPRESSION: 1, _PHOTOMETRIC: 1, _SAMPLES: 1, _FORMAT: 1}
# Compressions without loss: none, LZW, Deflate under both numbers, PackBits, Zstandard.
_LOSSLESS = (1, 5, 8, 32946, 32773, 50000)
# Pillow's names of pixel modes by photometric interpretation, samples, bits and format (1: unsigned, 3: float).
_MODES = {(1, 1, 8, 1): "L", (1, 1, 16, 1): "I;16", (1, 1, 32, 3): "F", (2, 3, 8, 1): "RGB", (2, 4, 8, 1): "RGBA"}


@dataclass(frozen=True)
class TiffHeader:
    """Pixel mode in Pillow's terms, and (width, height) of the first image of a TIFF."""

    mode: str
    size: tuple[int, int]
    format: str = "TIFF"


def read_tiff_header(file: IO[bytes]) -> AbstractContextManager[TiffHeader]:
    """Return the header of a TIFF, as a context manager as Pillow's readers do.

    Raises ValueError for other pixels than 8 or 16 bits or float32, and for lossy compression; struct.error for a file
    that is cut.
    """
    data = file.read()
    order = "<" if data.startswith(MAGICS[0]) else ">"
    (position,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, position)
    found = dict(_DEFAULTS)
    for index in range(count):
        tag, kind, number = struct.unpack_from(f"{order}HHI", data, position + 2 + 12 * index)
        value_at = position + 10 + 12 * index
        if tag not in (_WIDTH, _HEIGHT, *_DEFAULTS) or kind not in (3, 4) or number < 1:
            continue
        # Several values, such as the bits of each sample, are elsewhere; the first one counts.
        size = 2 if kind == 3 else 4
        if size * number > 4:
            (value_at,) = struct.unpack_from(f"{order}I", data, value_at)
        (found[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, value_at)
    # Pixels of which the lowest value is white are stored inverted, which OpenCV does not undo.
    mode = _MODES.get((found[_PHOTOMETRIC], found[_SAMPLES], found[_BITS], found[_FORMAT]))
    if mode is None or found[_COMPRESSION] not in _LOSSLESS or not found.get(_WIDTH) or not found.get(_HEIGHT):
        raise ValueError("not a TIFF of labels or depth")
    return nullcontext(TiffHeader(mode, (found[_WIDTH], found[_HEIGHT])))
