"""Decoding of RVL, a lossless compression of 16-bit depth images.

A. D. Wilson, 'Fast lossless depth image compression', ACM ISS 2017, https://doi.org/10.1145/3132272.3134144
"""

from __future__ import annotations

import numpy as np

from octoreplay.records import Int64Array

# Nibbles of a 32-bit number, of 3 bits each.
_MOST_NIBBLES = 11


def decode_rvl(data: bytes, num_pixels: int) -> np.ndarray[tuple[int], np.dtype[np.uint16]]:
    """Return the depth values (num_pixels,) uint16 of an RVL stream.

    The stream consists of little-endian 32-bit words, which hold nibbles from the highest bits down. A number has 3
    bits in each nibble, the lowest first; the fourth bit marks all nibbles but its last one. The numbers are, in turn:
    how many zeros follow, how many other values follow, and the difference d of each of these values to the last value
    that is not zero, as 2 d or -2 d - 1. Raises ValueError where the stream does not hold ``num_pixels`` values.
    """
    numbers = _numbers(data)
    # A memory view gives Python integers faster than an array.
    values, at, filled = memoryview(numbers.data), 0, 0
    firsts, starts, lengths = [], [], []
    while filled < num_pixels:
        start = filled + (values[at] if at < len(values) else 0)
        # The last number does not count where the image ends with zeros.
        others = values[at + 1] if at + 1 < len(values) and start < num_pixels else 0
        stop = start + others
        if not filled < stop <= num_pixels or (others and at + 2 + others > len(values)):
            raise ValueError("not an RVL stream of this size")
        firsts.append(at + 2)
        starts.append(start)
        lengths.append(others)
        at, filled = at + 2 + others, stop
    codes = numbers[_in_runs(firsts, lengths, numbers.size)]
    depth = np.zeros(num_pixels, dtype=np.uint16)
    # Differences wrap around at 16 bits.
    depth[_in_runs(starts, lengths, num_pixels)] = np.cumsum((codes >> 1) ^ -(codes & 1))
    return depth


def _in_runs(starts: list[int], lengths: list[int], size: int) -> Int64Array:
    """Positions below ``size`` in runs in ascending order."""
    first, length = np.array(starts, dtype=np.int64), np.array(lengths, dtype=np.int64)
    first, length = first[length > 0], length[length > 0]
    # One run may begin where another one ends.
    edges = np.zeros(size + 1, dtype=np.int8)
    edges[first] += 1
    edges[first + length] -= 1
    return np.flatnonzero(np.cumsum(edges[:-1], dtype=np.int8))


def _numbers(data: bytes) -> Int64Array:
    """The numbers (N,) in the nibbles of a stream. Raises ValueError for one of more than 32 bits."""
    octets = np.frombuffer(data, "<u4", count=len(data) // 4).astype(">u4").view(np.uint8)
    nibbles = np.stack([octets >> 4, octets & 15], axis=1).reshape(-1)
    # What follows the last end of a number is cut.
    ends = np.flatnonzero(nibbles < 8)
    # Positions of the nibbles of one place in their numbers, and of these numbers; a mask would be slower.
    places = np.concatenate([np.zeros(1, ends.dtype), ends[:-1] + 1]) if ends.size else ends
    numbers: Int64Array = (nibbles[places] & 7).astype(np.int64)
    owners = np.flatnonzero(places != ends)
    for index in range(1, _MOST_NIBBLES):
        if owners.size == 0:
            break
        places = places[owners] + 1 if index == 1 else places + 1
        numbers[owners] |= (nibbles[places] & 7).astype(np.int64) << 3 * index
        going_on = np.flatnonzero(places != ends[owners])
        places, owners = places[going_on], owners[going_on]
    if owners.size:
        raise ValueError("a number in the RVL stream is too long")
    return numbers
