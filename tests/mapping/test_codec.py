"""Packets: maps as bytes and back."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.mapping import codec
from octoreplay.mapping.codec import MapVersion, PacketFormat
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree, octree_from_streams
from octoreplay.mapping.quantise import CONTENTS
from octoreplay.mapping.streams import leaf_list, leaf_values
from support.octree_factory import cells_of, cube, octree_of
from support.packets import (
    HEADER,
    LIMIT,
    PLAIN,
    code_of,
    naive_cells,
    octrees,
)


@settings(max_examples=60, deadline=None)
@given(octree=octrees(), level=st.sampled_from([None, 1, 3, 22]), prune=st.booleans())
def test_decoding_restores_the_map_bit_for_bit(octree, level, prune):
    packet = codec.encode_packet(octree, packet_format=PacketFormat(zstd_level=level), prune=prune)
    decoded = codec.decode_packet(packet)
    assert (decoded.resolution, decoded.num_classes) == (octree.resolution, octree.num_classes)
    assert cells_of(decoded) == cells_of(octree)
    # Pruned streams are canonical: the same map gives the same bytes, however it was pruned before.
    assert codec.encode_packet(decoded) == codec.encode_packet(octree)


@settings(max_examples=60, deadline=None)
@given(octree=octrees(), prune=st.booleans())
def test_streams_follow_the_documented_format(octree, prune):
    streams = octree.streams(prune=prune)
    assert naive_cells(streams.words.tolist(), streams, octree.num_classes) == cells_of(octree)


@settings(max_examples=60, deadline=None)
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


@settings(max_examples=40, deadline=None)
@given(before=octrees(num_classes=2), after=octrees(num_classes=2), data=st.data())
def test_delta_replaces_its_bricks(before, after, data):
    after.resolution = before.resolution
    chosen = np.array(sorted(data.draw(st.sets(st.integers(0, max(after.num_bricks - 1, 0))))), np.int64)
    chosen = chosen[chosen < after.num_bricks]
    packet = codec.encode_delta(after, chosen)
    codes = set(after.codes[chosen].tolist())
    expected = {key: value for key, value in cells_of(before).items() if code_of(key) not in codes}
    expected |= {key: value for key, value in cells_of(after).items() if code_of(key) in codes}
    codec.apply_delta(before, packet, revision=7)
    assert cells_of(before) == expected
    assert set(before.codes[before.revisions == 7].tolist()) == codes


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
