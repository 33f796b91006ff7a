"""Naive implementation of docs/packet-format.md, forged packets, and random octrees."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import zstandard
from hypothesis import strategies as st

from octoreplay.mapping.kernels import storage
from support.octree_factory import brick_code, cube, octree_of

LIMIT = storage.KEY_OFFSET
HEADER = "<4sBBBBdqHHIIIfIIIIII"
DTYPES = {"float32": "<f4", "float16": "<f2", "int8": "i1"}
VALUES = st.sampled_from([0.0, -5.0, 5.0, -0.3, 1.0, 1e-30, -3e38, float(np.float32(0.1))])


@st.composite
def octrees(draw, num_classes=None):
    """Octrees of single cells and cubes, near the origin (keys of both signs) and at the ends of the key space."""
    num_classes = num_classes or draw(st.sampled_from([1, 2, 5, 9, 20]))
    corners = st.sampled_from([-LIMIT, -LIMIT + 64, -64, -17, -8, -1, 0, 3, 8, 40, LIMIT - 64])
    cells = {}
    for _ in range(draw(st.integers(0, 6))):
        edge = draw(st.sampled_from([1, 1, 2, 3, 4, 8, 16]))
        corner = [draw(corners) for _ in range(3)]
        # One value for each class, or a few values shared by several classes.
        palette = [draw(VALUES) for _ in range(draw(st.integers(1, 3)))]
        values = [draw(VALUES if draw(st.booleans()) else st.sampled_from(palette)) for _ in range(num_classes)]
        values = [palette[0]] * num_classes if draw(st.booleans()) else values
        cells.update(cube(corner, edge, values))
    return octree_of(cells, num_classes=num_classes, resolution=draw(st.sampled_from([0.25, 0.3, 1e-3, 7.0])))


def naive_cells(words, streams, num_classes):
    """{key: bytes of its values} read recursively after docs/packet-format.md; None for words that are no octree.

    Leaves larger than 32 cells are skipped.
    """
    rest = [list(words), list(streams.values), streams.masks.tolist(), list(streams.own_values)]
    content = {}

    def read_leaf(state):
        values = np.full(num_classes, rest[1].pop(0))
        mask = rest[2].pop(0) if state == 3 else []
        for c in range(num_classes if mask else 0):
            if mask[c // 8] >> (c % 8) & 1:
                values[c] = rest[3].pop(0)
        return values.tobytes()

    def read_node(corner, edge):
        word = rest[0].pop(0)
        for child in range(8):
            state = (word >> (2 * child)) & 3
            low = [k + edge // 2 * (child >> axis & 1) for axis, k in enumerate(corner)]
            if state == 1:
                if edge == 2:
                    raise IndexError
                read_node(low, edge // 2)
            elif state:
                value = read_leaf(state)
                if edge <= 64:
                    content.update(cube(low, edge // 2, value))

    try:
        if rest[0]:
            read_node((-LIMIT,) * 3, 2 * LIMIT)
    except IndexError:
        return None
    return None if any(rest) else content


def code_of_key(key):
    return brick_code(tuple(k >> storage.BRICK_BITS for k in key))


# --- compression ------------------------------------------------------------------------------------------------------


def naive_codes(numbers):
    """Codes of numbers (bytes of each), then their literals byte by byte, after docs/packet-format.md."""
    slots, codes, literals = {}, [], []
    for number in numbers:
        bits = int.from_bytes(number, "little")
        slot = max((bits * 2654435761 % 2**32) // 2**24, 1)
        if slots.get(slot, 0) == bits:
            codes.append(slot)
            continue
        slots[slot] = bits
        codes.append(0)
        literals.append(number)
    return bytes(codes) + bytes(number[i] for i in range(len(numbers[0]) if numbers else 0) for number in literals)


def coded_payload(payload, counts, width=4, num_classes=2):
    """Content of the compressed payload with these counts."""
    ends = np.cumsum([2 * counts[0], width * counts[1], counts[2] * -(-num_classes // 8)]).tolist()
    words, values, masks, own = (payload[a:b] for a, b in zip([0, *ends], [*ends, None], strict=True))

    def coded(content):
        return naive_codes([content[i : i + width] for i in range(0, len(content), width)])

    return words + coded(values) + masks + coded(own)


def counts_of(header):
    return header.num_words, header.num_leaves, header.num_vectors, header.num_own_values


def slot_of(value):
    return max((int.from_bytes(struct.pack("<f", value), "little") * 2654435761 % 2**32) // 2**24, 1)


def compressed_packet(payload, counts):
    return forged(zstandard.ZstdCompressor().compress(payload), counts=counts, compression=1)


def forged(
    payload, *, version=3, kind=0, content=0, compression=0, num_classes=2, resolution=0.25, map_version=(0, 0, 0, 0),
    weight=0, step=0.0, counts,
):  # fmt: skip
    """A packet with arbitrary content and a valid checksum."""
    fields = (
        b"OCTM", version, kind, content, compression, resolution, weight, num_classes, *map_version, step, *counts,
        len(payload),
    )  # fmt: skip
    checksum = zlib.crc32(payload, zlib.crc32(struct.pack(HEADER, *fields, 0)))
    return struct.pack(HEADER, *fields, checksum) + payload


def words_of(*words):
    return np.array(words, "<u2").tobytes()


CHAIN = (1,) * 18
"""Child 0 of every node down to depth 18."""
