"""Compression of packets."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.errors import PacketError
from octoreplay.mapping import codec
from octoreplay.mapping.codec import PacketFormat
from octoreplay.mapping.kernels import packets
from octoreplay.mapping.quantise import CONTENTS, quantised
from support.octree_factory import cells_of, cube, octree_of
from support.packets import (
    CHAIN,
    LIMIT,
    PLAIN,
    coded_payload,
    counts_of,
    forged,
    naive_codes,
    octrees,
    packed,
)


@settings(max_examples=60, deadline=None)
@given(octree=octrees(), content=st.sampled_from(CONTENTS), prune=st.booleans())
def test_compressed_payload_follows_the_documented_format(octree, content, prune):
    octree = quantised(octree, content, 0.05)
    plain = codec.encode_packet(octree, packet_format=PacketFormat(content, zstd_level=None), prune=prune)
    packet = codec.encode_packet(octree, packet_format=PacketFormat(content), prune=prune)
    header = codec.read_header(packet)
    assert header.raw_bytes == len(plain) - codec.HEADER_BYTES
    expected = plain[codec.HEADER_BYTES :]
    if content != "int8":
        width = 4 if content == "float32" else 2
        expected = coded_payload(expected, counts_of(header), width, octree.num_classes)
    assert zstandard.ZstdDecompressor().decompress(packet[codec.HEADER_BYTES :]) == expected


@settings(max_examples=100, deadline=None)
@given(
    numbers=st.lists(st.sampled_from([0, 1, 2, 255, 256, 2**16 - 1, 2**31, 2**32 - 1, 0xC0A00000, 377, 754, 1131])),
    width=st.sampled_from([2, 4]),
)
def test_codes_and_literals_equal_the_naive_ones_in_both_directions(numbers, width):
    numbers = np.array([number % 2 ** (8 * width) for number in numbers], np.uint32)
    codes, literals = np.empty(numbers.size, np.uint8), np.empty((4, numbers.size), np.uint8)
    num_literals = packets.write_codes(numbers, np.zeros(256, np.uint32), codes, literals)
    coded = codes.tobytes() + literals[:width, :num_literals].tobytes()
    assert coded == naive_codes([number.tobytes()[:width] for number in numbers.astype("<u4")])
    padded = np.zeros((4, num_literals + 1), np.uint8)
    padded[:, :-1] = literals[:, :num_literals]
    again = np.empty_like(numbers)
    codes.flags.writeable = False
    packets.read_codes(codes, padded, np.zeros(256, np.uint32), again)
    assert again.tolist() == numbers.tolist()


def _slot(value):
    return max((int.from_bytes(struct.pack("<f", value), "little") * 2654435761 % 2**32) // 2**24, 1)


def test_arbitrary_codes_follow_the_documented_format():
    """Empty slots hold 0. Literals are written to their slot, even if it already holds the same number."""
    first = next(value for value in range(2, 10000) if _slot(value) == 1)  # same slot as 0
    codes = bytes([255, 0, 0, _slot(1.0), 0, 9, 1, _slot(1.0)])
    literals = b"".join(bytes(plane) for plane in zip(*(struct.pack("<f", n) for n in (1.0, 1.0, first)), strict=True))
    packet = _compressed(packed(*CHAIN, 0xAAAA) + codes + literals, (19, 8, 0, 0))
    expected = {
        tuple(-LIMIT + (child >> axis & 1) for axis in range(3)): np.full(2, value, np.float32).tobytes()
        for child, value in enumerate([0.0, 1.0, 1.0, 1.0, first, 0.0, first, 1.0])
    }
    assert cells_of(codec.decode_packet(packet)) == expected


@pytest.mark.parametrize("change", [-1, 1])
def test_codes_with_another_number_of_literals_are_refused(change):
    octree = octree_of({(0, 0, 0): [1.0, 2.0], (1, 0, 0): [1.0, 1.0]})
    packet = codec.encode_packet(octree)
    counts = counts_of(codec.read_header(packet))
    payload = zstandard.ZstdDecompressor().decompress(packet[codec.HEADER_BYTES :])
    assert codec.decode_packet(_compressed(payload, counts)).num_cells == 2
    wrong = payload + bytes(4) if change > 0 else payload[:-1]
    with pytest.raises(PacketError, match="size"):
        codec.decode_packet(_compressed(wrong, counts))


def _compressed(payload, counts):
    return forged(zstandard.ZstdCompressor().compress(payload), counts=counts, compression=1)


@pytest.fixture(scope="module")
def noisy():
    """A map with a few hundred different values in random order, which zstd cannot predict."""
    rng = np.random.default_rng(3)
    palette = rng.normal(0, 2, 300).astype(np.float32)
    cells = {}
    for key in cube((-8, 0, -8), 16, 0.0):
        shared, own = palette[rng.geometric(0.02, 2) % 300]
        cells[key] = [shared, own if rng.random() < 0.2 else shared]
    return octree_of(cells)


def test_codes_and_separate_blocks_make_packets_smaller(noisy):
    plain = codec.encode_packet(noisy, packet_format=PLAIN)[codec.HEADER_BYTES :]
    packet = codec.encode_packet(noisy)
    coded = coded_payload(plain, counts_of(codec.read_header(packet)))
    in_one_piece = zstandard.ZstdCompressor(level=1).compress(coded)
    assert len(packet) < 0.98 * len(in_one_piece) < 0.8 * len(zstandard.ZstdCompressor(level=1).compress(plain))


def test_level_does_not_change_the_decompressed_payload(noisy):
    packets_of_levels = [codec.encode_packet(noisy, packet_format=PacketFormat(zstd_level=n)) for n in (1, 3, 19)]
    assert len(set(packets_of_levels)) == 3
    assert packets_of_levels[0] == codec.encode_packet(noisy)
    payloads = {zstandard.ZstdDecompressor().decompress(packet[codec.HEADER_BYTES :]) for packet in packets_of_levels}
    assert len(payloads) == 1
