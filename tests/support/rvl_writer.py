"""RVL streams, written and read number by number: the naive twin of the package's decoder."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator

import numpy as np


def encode_rvl(depth: np.ndarray) -> bytes:
    """The stream of a depth image."""
    values = [int(value) for value in depth.reshape(-1)]
    numbers, previous, at = [], 0, 0
    while at < len(values):
        start = at
        while at < len(values) and values[at] == 0:
            at += 1
        numbers.append(at - start)
        start = at
        while at < len(values) and values[at] != 0:
            at += 1
        numbers.append(at - start)
        for value in values[start:at]:
            difference, previous = value - previous, value
            numbers.append(2 * difference if difference >= 0 else -2 * difference - 1)
    return words_of(nibble for number in numbers for nibble in nibbles_of(number))


def nibbles_of(number: int) -> list[int]:
    """The nibbles of a number."""
    parts = [number & 7]
    while number := number >> 3:
        parts[-1] |= 8
        parts.append(number & 7)
    return parts


def words_of(nibbles: Iterable[int]) -> bytes:
    """Little-endian words with eight nibbles each, the first one in the highest bits."""
    text = "".join(f"{nibble:x}" for nibble in nibbles)
    text += "0" * (-len(text) % 8)
    return b"".join(struct.pack("<I", int(text[at : at + 8], 16)) for at in range(0, len(text), 8))


def decode_naively(data: bytes, num_pixels: int) -> np.ndarray | None:
    """The values of a stream; None where it does not hold this number of them."""
    nibbles = _nibbles(data)
    depth: list[int] = []
    previous = 0
    try:
        while len(depth) < num_pixels:
            zeros = _number(nibbles)
            depth += [0] * min(zeros, num_pixels + 1)
            others = _number(nibbles) if len(depth) < num_pixels else 0
            if len(depth) + others > num_pixels or zeros + others == 0:
                return None
            for _ in range(others):
                code = _number(nibbles)
                previous = (previous + (-(code + 1) // 2 if code % 2 else code // 2)) % 65536
                depth.append(previous)
    except (StopIteration, ValueError):
        return None
    return np.array(depth, np.uint16)


def _nibbles(data: bytes) -> Iterator[int]:
    for (word,) in struct.iter_unpack("<I", data[: len(data) // 4 * 4]):
        yield from (int(digit, 16) for digit in f"{word:08x}")


def _number(nibbles: Iterator[int]) -> int:
    number = 0
    for shift in range(0, 33, 3):
        nibble = next(nibbles)
        number |= (nibble & 7) << shift
        if nibble < 8:
            return number
    raise ValueError("too long")
