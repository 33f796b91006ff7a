"""Map packets: lossless round trips, number formats and compression."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.errors import PacketError
from octoreplay.mapping import codec
from octoreplay.mapping.codec import MapVersion, PacketFormat
from octoreplay.mapping.kernels import packets, storage
from octoreplay.mapping.octree import SemanticOctree, octree_from_streams
from octoreplay.mapping.quantise import CONTENTS, quantised
from octoreplay.mapping.streams import leaf_list, leaf_values
from support.long_suite import examples, long
from support.octree_factory import cells_of, cube, octree_of
from support.packet_format import (
    CHAIN,
    HEADER,
    LIMIT,
    code_of_key,
    coded_payload,
    compressed_packet,
    counts_of,
    naive_cells,
    naive_codes,
    octrees,
    slot_of,
    words_of,
)

PLAIN = PacketFormat(zstd_level=None)


@examples(60)
@given(octree=octrees(), level=st.sampled_from([None, 1, 3, 22]), prune=st.booleans())
def test_decoding_restores_the_map_bit_for_bit(octree, level, prune):
    packet = codec.encode_packet(octree, packet_format=PacketFormat(zstd_level=level), prune=prune)
    decoded = codec.decode_packet(packet)
    assert (decoded.resolution, decoded.num_classes) == (octree.resolution, octree.num_classes)
    assert cells_of(decoded) == cells_of(octree)
    # Pruned streams are canonical: the same map gives the same bytes, however it was pruned before.
    assert codec.encode_packet(decoded) == codec.encode_packet(octree)


@examples(60)
@given(octree=octrees(), prune=st.booleans())
def test_streams_follow_the_documented_format(octree, prune):
    streams = octree.streams(prune=prune)
    assert naive_cells(streams.words.tolist(), streams, octree.num_classes) == cells_of(octree)


@examples(60)
@given(octree=octrees())
def test_leaf_stores_the_value_of_most_classes_and_the_others(octree):
    streams = octree.streams(prune=False)
    _, _, is_vector = leaf_list(streams)
    values = leaf_values(streams, is_vector, octree.num_classes)
    places = np.cumsum([0, *np.bitwise_count(streams.masks).sum(axis=1, dtype=np.int64)])
    for leaf, shared, start, end in zip(values[is_vector], streams.values[is_vector], places, places[1:], strict=False):
        counts = [np.count_nonzero(leaf == value) for value in leaf]
        assert shared == leaf[np.argmax(counts)]
        assert streams.own_values[start:end].tolist() == [value for value in leaf if value != shared]


@examples(40)
@given(before=octrees(num_classes=2), after=octrees(num_classes=2), data=st.data())
def test_delta_replaces_its_bricks(before, after, data):
    after.resolution = before.resolution
    chosen = np.array(sorted(data.draw(st.sets(st.integers(0, max(after.num_bricks - 1, 0))))), np.int64)
    chosen = chosen[chosen < after.num_bricks]
    packet = codec.encode_delta(after, chosen)
    codes = set(after.codes[chosen].tolist())
    expected = {key: value for key, value in cells_of(before).items() if code_of_key(key) not in codes}
    expected |= {key: value for key, value in cells_of(after).items() if code_of_key(key) in codes}
    codec.apply_delta(before, packet, revision=7)
    assert cells_of(before) == expected
    assert set(before.codes[before.revisions == 7].tolist()) == codes


@long
@examples(40)
@given(octree=octrees(), level=st.sampled_from([None, 1, 3]), version=st.integers(0, 2**32 - 1))
def test_a_delta_without_bricks_is_that_of_the_streams(octree, level, version):
    nothing, packet_format = np.empty(0, np.int64), PacketFormat(zstd_level=level)
    map_version = MapVersion(origin=1, version=version, base=version // 2)
    packet = codec.encode_delta(octree, nothing, packet_format=packet_format, map_version=map_version)
    assert packet == codec.pack(octree, octree.streams(nothing), codec.DELTA, packet_format, map_version)


def test_large_uniform_cubes_are_one_leaf():
    octree = octree_of(cube((-64, -64, -64), 64, [-5.0, -5.0]))
    streams = octree.streams()
    assert (streams.values.tolist(), streams.masks.shape, streams.own_values.size) == ([-5.0], (0, 1), 0)
    assert codec.decode_packet(codec.encode_packet(octree)).num_cells == 64**3
    hit = octree_of(cube((64, 0, -32), 32, [1.0, -0.3]))
    streams = hit.streams()
    assert (streams.values.tolist(), streams.masks.tolist()) == ([1.0], [[2]])
    assert streams.own_values.tolist() == [pytest.approx(-0.3)]
    assert cells_of(codec.decode_packet(codec.encode_packet(hit))) == cells_of(hit)


def test_corners_of_the_key_space():
    ends = (-LIMIT, LIMIT - 1)
    cells = {(x, y, z): [float(x > 0), float(y > 0) + 2 * (z > 0)] for x in ends for y in ends for z in ends}
    octree = octree_of(cells)
    assert set(cells_of(octree)) == set(cells)
    assert cells_of(codec.decode_packet(codec.encode_packet(octree))) == cells_of(octree)


def test_empty_map():
    octree = SemanticOctree(0.2, 3)
    packet = codec.encode_packet(octree, packet_format=PLAIN)
    assert len(packet) == codec.HEADER_BYTES == 68
    assert codec.decode_packet(packet).num_bricks == 0
    assert codec.decode_packet(codec.encode_packet(octree)).num_classes == 3


def test_bricks_without_a_known_cell_take_no_words():
    octree = octree_of({(0, 0, 0): [1.0, 2.0]})
    packet = codec.encode_packet(octree)
    octree.find_or_add(np.array([0, 1, 77], np.int64))
    assert codec.encode_packet(octree) == packet
    octree.bricks.known[:] = 0
    assert octree.streams().words.size == octree.streams(prune=False).words.size == 0


def test_equal_maps_give_equal_bytes_with_any_sign_of_0_and_order_of_bricks():
    cells = cube((-9, 0, 3), 12, [0.0, 1.0]) | cube((0, 0, 0), 4, [0.0, 0.0]) | {(50, 0, 0): [0.0, 0.0]}
    packet = codec.encode_packet(octree_of(cells))
    signed = {key: [-value if value == 0 else value for value in values] for key, values in reversed(cells.items())}
    assert codec.encode_packet(octree_of(signed)) == packet


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("tolerance", [0.0, 0.5])
def test_nan_and_infinity_are_kept(value, tolerance):
    """Packets may contain them, unlike scans. Other values must not change, and no write may be out of bounds."""
    octree = SemanticOctree(0.25, 3)
    octree.find_or_add(np.arange(64))
    masks = np.repeat([0, 0x0001_0507_0203_0004, 0], [22, 21, 21]).astype(np.uint64)[:, None]
    has_block = np.repeat([True, False], [43, 21])
    octree.expand_bricks(np.arange(64), masks, np.full(64, storage.ALL_CELLS), has_block)
    for array in (octree.bricks.values, octree.bricks.rows):
        array[:] = value
    streams = octree.streams(tolerance=tolerance)
    decoded = octree_from_streams(streams, 0.25, 3)
    assert decoded.num_cells == octree.num_cells
    assert np.array_equal(streams.values, np.full_like(streams.values, value), equal_nan=True)
    assert streams.masks.size == 0
    assert len(cells_of(decoded)) == 64 * 64


def test_bytes_by_hand():
    """One vector leaf at key (0, 0, 0): child 7 of the root, then child 0 of each node."""
    octree = octree_of({(0, 0, 0): [1.5, -2.0]})
    words = struct.pack("<19H", *(state << (2 * child) for state, child in [(1, 7)] + [(1, 0)] * 17 + [(3, 0)]))
    numbers = {"float32": ("f", 1.5, -2.0), "float16": ("e", 1.5, -2.0), "int8": ("b", 3, -4)}
    for content, (code, shared, own) in numbers.items():
        payload = words + struct.pack(f"<{code}B{code}", shared, 0b10, own)
        map_version = MapVersion(origin=5, epoch=2, version=9, weight=-7)
        packet_format = PacketFormat(content, step=0.5, zstd_level=None)
        packet = codec.encode_packet(octree, packet_format=packet_format, map_version=map_version)
        step = 0.5 if content == "int8" else 0.0
        numbers_of_header = (0.25, -7, 2, 5, 2, 9, 0, step, 19, 1, 1, 1, len(payload))
        fields = (b"OCTM", 3, 0, CONTENTS.index(content), 0, *numbers_of_header)
        checksum = zlib.crc32(payload, zlib.crc32(struct.pack(HEADER, *fields, 0)))
        assert packet == struct.pack(HEADER, *fields, checksum) + payload
        assert codec.read_header(packet).raw_bytes == len(payload)


def test_merging_with_tolerance_stays_within_its_bound():
    cells = cube((0, 0, 0), 2, [1.0, 0.0]) | {(1, 1, 1): [1.25, -0.25]}
    octree = octree_of(cells)
    assert codec.read_header(codec.encode_packet(octree, tolerance=0.2)).num_vectors == 8
    packet = codec.encode_packet(octree, tolerance=0.25)
    assert codec.read_header(packet).num_vectors == 1
    merged = codec.decode_packet(packet)
    assert {np.frombuffer(value, np.float32).tobytes() for value in cells_of(merged).values()} == {
        np.array([1.125, -0.125], np.float32).tobytes()
    }


def test_grid_bytes():
    assert codec.grid_bytes(10, 5) == 10 * (8 + 6 * 4)


# --- contents ---------------------------------------------------------------------------------------------------------


@long
@examples(60)
@given(
    octree=octrees(), content=st.sampled_from(CONTENTS), step=st.sampled_from([0.05, 0.3, 1e-3]), level=st.booleans(),
    every=st.integers(1, 3),
)  # fmt: skip
def test_quantised_maps_are_restored_bit_for_bit(octree, content, step, level, every):
    octree = quantised(octree, content, step)
    packet_format = PacketFormat(content, step, 1 if level else None)
    packet = codec.encode_packet(octree, packet_format=packet_format)
    decoded = codec.decode_packet(packet)
    assert cells_of(decoded) == cells_of(octree)
    # Equal maps give equal bytes, whatever they were quantised from.
    assert codec.encode_packet(decoded, packet_format=packet_format) == packet
    chosen = np.arange(0, octree.num_bricks, every)
    receiver = SemanticOctree(octree.resolution, octree.num_classes)
    codec.apply_delta(receiver, codec.encode_delta(octree, chosen, packet_format=packet_format))
    codes = set(octree.codes[chosen].tolist())
    assert cells_of(receiver) == {key: value for key, value in cells_of(octree).items() if code_of_key(key) in codes}


def test_values_that_a_content_cannot_represent_are_refused():
    octree = octree_of({(0, 0, 0): [0.1, 0.15]})
    for content in ("float16", "int8"):
        packet_format = PacketFormat(content, step=0.2)
        with pytest.raises(ValueError, match=f"{content} cannot represent"):
            codec.encode_packet(octree, packet_format=packet_format)
        with pytest.raises(ValueError, match=f"{content} cannot represent"):
            codec.encode_delta(octree, np.arange(1), packet_format=packet_format)
    for content, step in [("float64", 0.2), ("int8", 0.0), ("int8", 1e-60), ("int8", 1e60), ("int8", float("nan"))]:
        with pytest.raises(ValueError, match="step" if content == "int8" else "content 'float64'"):
            codec.encode_packet(SemanticOctree(0.25, 2), packet_format=PacketFormat(content, step))


def test_midpoints_of_merged_values_that_are_no_steps_are_refused():
    octree = octree_of(cube((0, 0, 0), 2, [1.0, 0.0]) | {(1, 1, 1): [1.5, 0.0]})
    packet_format = PacketFormat("int8", step=0.5)
    assert codec.encode_packet(octree, packet_format=packet_format, tolerance=0.4)
    with pytest.raises(ValueError, match="int8 cannot represent"):
        codec.encode_packet(octree, packet_format=packet_format, tolerance=0.5)


def test_siblings_made_equal_by_quantisation_are_one_leaf():
    """Across rows, octets, bricks and classes."""
    rng = np.random.default_rng(5)
    cells = {key: rng.uniform(0.96, 1.04, 3) for key in cube((0, 0, 0), 8, 0.0)}
    octree = octree_of(cells, num_classes=3)
    assert codec.read_header(codec.encode_packet(octree)).num_leaves == 512
    packet_format = PacketFormat("int8", step=0.1)
    packet = codec.encode_packet(quantised(octree, "int8", 0.1), packet_format=packet_format)
    header = codec.read_header(packet)
    assert (header.num_leaves, header.num_vectors) == (1, 0)
    exact = octree_of(dict.fromkeys(cells, float(np.float32(0.1) * np.float32(10))), num_classes=3)
    assert codec.encode_packet(exact, packet_format=packet_format) == packet


@examples(60)
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


@examples(100)
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


def test_arbitrary_codes_follow_the_documented_format():
    """Empty slots hold 0. Literals are written to their slot, even if it already holds the same number."""
    first = next(value for value in range(2, 10000) if slot_of(value) == 1)  # same slot as 0
    codes = bytes([255, 0, 0, slot_of(1.0), 0, 9, 1, slot_of(1.0)])
    literals = b"".join(bytes(plane) for plane in zip(*(struct.pack("<f", n) for n in (1.0, 1.0, first)), strict=True))
    packet = compressed_packet(words_of(*CHAIN, 0xAAAA) + codes + literals, (19, 8, 0, 0))
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
    assert codec.decode_packet(compressed_packet(payload, counts)).num_cells == 2
    wrong = payload + bytes(4) if change > 0 else payload[:-1]
    with pytest.raises(PacketError, match="size"):
        codec.decode_packet(compressed_packet(wrong, counts))


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
