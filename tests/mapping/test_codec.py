from __future__ import annotations

import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.errors import PacketError
from octoreplay.mapping import codec
from octoreplay.mapping import octree as octree_module
from octoreplay.mapping.codec import MapVersion, PacketFormat
from octoreplay.mapping.kernels import packets, storage
from octoreplay.mapping.octree import SemanticOctree, octree_from_streams
from octoreplay.mapping.quantise import CONTENTS, quantised
from octoreplay.mapping.streams import leaf_list, leaf_values
from support.octree_factory import brick_code, cells_of, cube, octree_of

LIMIT = storage.KEY_OFFSET
PLAIN = PacketFormat(zstd_level=None)
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
    assert _naive_cells(streams.words.tolist(), streams, octree.num_classes) == cells_of(octree)


def _naive_cells(words, streams, num_classes):
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
    expected = {key: value for key, value in cells_of(before).items() if _code(key) not in codes}
    expected |= {key: value for key, value in cells_of(after).items() if _code(key) in codes}
    codec.apply_delta(before, packet, revision=7)
    assert cells_of(before) == expected
    assert set(before.codes[before.revisions == 7].tolist()) == codes


def _code(key):
    return brick_code(tuple(k >> storage.BRICK_BITS for k in key))


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


@settings(max_examples=60, deadline=None)
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
    assert cells_of(receiver) == {key: value for key, value in cells_of(octree).items() if _code(key) in codes}


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


# --- compression ------------------------------------------------------------------------------------------------------


def _naive_codes(numbers):
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


def _coded_payload(payload, counts, width=4, num_classes=2):
    """Content of the compressed payload with these counts."""
    ends = np.cumsum([2 * counts[0], width * counts[1], counts[2] * -(-num_classes // 8)]).tolist()
    words, values, masks, own = (payload[a:b] for a, b in zip([0, *ends], [*ends, None], strict=True))

    def coded(content):
        return _naive_codes([content[i : i + width] for i in range(0, len(content), width)])

    return words + coded(values) + masks + coded(own)


def _counts(header):
    return header.num_words, header.num_leaves, header.num_vectors, header.num_own_values


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
        expected = _coded_payload(expected, _counts(header), width, octree.num_classes)
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
    assert coded == _naive_codes([number.tobytes()[:width] for number in numbers.astype("<u4")])
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
    packet = _compressed(_words(*CHAIN, 0xAAAA) + codes + literals, (19, 8, 0, 0))
    expected = {
        tuple(-LIMIT + (child >> axis & 1) for axis in range(3)): np.full(2, value, np.float32).tobytes()
        for child, value in enumerate([0.0, 1.0, 1.0, 1.0, first, 0.0, first, 1.0])
    }
    assert cells_of(codec.decode_packet(packet)) == expected


@pytest.mark.parametrize("change", [-1, 1])
def test_codes_with_another_number_of_literals_are_refused(change):
    octree = octree_of({(0, 0, 0): [1.0, 2.0], (1, 0, 0): [1.0, 1.0]})
    packet = codec.encode_packet(octree)
    counts = _counts(codec.read_header(packet))
    payload = zstandard.ZstdDecompressor().decompress(packet[codec.HEADER_BYTES :])
    assert codec.decode_packet(_compressed(payload, counts)).num_cells == 2
    wrong = payload + bytes(4) if change > 0 else payload[:-1]
    with pytest.raises(PacketError, match="size"):
        codec.decode_packet(_compressed(wrong, counts))


def _compressed(payload, counts):
    return _forged(zstandard.ZstdCompressor().compress(payload), counts=counts, compression=1)


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
    coded = _coded_payload(plain, _counts(codec.read_header(packet)))
    in_one_piece = zstandard.ZstdCompressor(level=1).compress(coded)
    assert len(packet) < 0.98 * len(in_one_piece) < 0.8 * len(zstandard.ZstdCompressor(level=1).compress(plain))


def test_level_does_not_change_the_decompressed_payload(noisy):
    packets_of_levels = [codec.encode_packet(noisy, packet_format=PacketFormat(zstd_level=n)) for n in (1, 3, 19)]
    assert len(set(packets_of_levels)) == 3
    assert packets_of_levels[0] == codec.encode_packet(noisy)
    payloads = {zstandard.ZstdDecompressor().decompress(packet[codec.HEADER_BYTES :]) for packet in packets_of_levels}
    assert len(payloads) == 1


# --- damage ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sample():
    return octree_of(cube((-3, -1, 0), 5, [-0.3, -0.3]) | {(0, 1, 2): [1.0, -0.3]})


def _refused(packet, sample):
    with pytest.raises(PacketError):
        codec.decode_packet(packet)
    before = cells_of(sample)
    with pytest.raises(PacketError):
        codec.apply_delta(sample, packet)
    assert cells_of(sample) == before


@pytest.mark.parametrize("level", [1, None])
@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("kind", ["packet", "delta"])
def test_every_damaged_byte_is_detected(sample, kind, content, level):
    options = {"packet_format": PacketFormat(content, zstd_level=level), "map_version": MapVersion(1, 2, 3, 0, 5)}
    sample = quantised(sample, content, 0.05)
    packet = codec.encode_packet(sample, **options)
    if kind == "delta":
        packet = codec.encode_delta(sample, np.arange(sample.num_bricks), **options)
    for place in range(len(packet)):
        for flip in (0x01, 0x80, 0xFF):
            damaged = bytearray(packet)
            damaged[place] ^= flip
            with pytest.raises(PacketError):
                codec.read_header(bytes(damaged))
    _refused(bytes([*packet[:-1], packet[-1] ^ 1]), sample)


@pytest.mark.parametrize("level", [1, None])
def test_cut_and_longer_packets_are_refused(sample, level):
    packet = codec.encode_packet(sample, packet_format=PacketFormat(zstd_level=level))
    for length in range(len(packet)):
        with pytest.raises(PacketError):
            codec.decode_packet(packet[:length])
    for tail in (b"\0", packet, b"OCTM"):
        _refused(packet + tail, sample)


def test_key_frames_and_deltas_are_not_interchangeable(sample):
    with pytest.raises(PacketError, match="is a delta"):
        codec.decode_packet(codec.encode_delta(sample, np.arange(2)))
    with pytest.raises(PacketError, match="not a delta"):
        codec.apply_delta(sample, codec.encode_packet(sample))
    other = octree_of({(0, 0, 0): [1.0, 1.0, 1.0]}, num_classes=3)
    with pytest.raises(PacketError, match="another resolution or number of classes"):
        codec.apply_delta(sample, codec.encode_delta(other, np.arange(1)))
    other = octree_of({(0, 0, 0): [1.0, 1.0]}, resolution=0.5)
    with pytest.raises(PacketError, match="another resolution or number of classes"):
        codec.apply_delta(sample, codec.encode_delta(other, np.arange(1)))


def _forged(
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


@pytest.mark.parametrize(
    "fields",
    [
        {"version": 2}, {"version": 4}, {"kind": 2}, {"content": 3}, {"content": 255}, {"compression": 2},
        {"num_classes": 0}, {"num_classes": 255},
        {"resolution": 0.0}, {"resolution": -0.25}, {"resolution": float("nan")}, {"resolution": float("inf")},
        {"step": 0.05}, {"content": 1, "step": 0.05}, {"step": float("nan")}, {"content": 2, "step": 0.0},
        {"content": 2, "step": -0.05}, {"content": 2, "step": float("nan")}, {"content": 2, "step": float("inf")},
        {"content": 2, "step": 3e36}, {"map_version": (0, 0, 5, 1)},
    ],
    ids=str,
)  # fmt: skip
def test_unknown_headers_are_refused(fields):
    good = {"counts": (0, 0, 0, 0), "content": fields.get("content", 0) % 3}
    good["step"] = 0.05 if good["content"] == 2 else 0.0
    assert codec.decode_packet(_forged(b"", **good)).num_bricks == 0
    with pytest.raises(PacketError):
        codec.decode_packet(_forged(b"", **good | fields))


def test_packets_of_other_versions_are_refused_with_their_version():
    with pytest.raises(PacketError, match="format version 2, this octoreplay reads version 3"):
        codec.read_header(b"OCTM\x02" + bytes(39))
    with pytest.raises(PacketError, match="cut: 67 bytes"):
        codec.read_header(_forged(b"", counts=(0, 0, 0, 0))[:-1])
    for data in (b"", b"OCT", b"OCTM", b"MTCO\x03" + bytes(63)):
        with pytest.raises(PacketError, match="not a map packet"):
            codec.read_header(data)


def test_base_of_a_delta_is_not_later_than_its_version():
    octree = octree_of({(0, 0, 0): [1.0, 2.0]})
    packet = _forged(b"", kind=1, map_version=(1, 0, 5, 5), counts=(0, 0, 0, 0))
    assert codec.read_header(packet).map_version == MapVersion(origin=1, version=5, base=5)
    codec.apply_delta(octree, packet)
    with pytest.raises(PacketError, match="base"):
        codec.apply_delta(octree, _forged(b"", kind=1, map_version=(1, 0, 5, 6), counts=(0, 0, 0, 0)))
    with pytest.raises(ValueError, match="base 6"):
        codec.encode_delta(octree, np.arange(1), map_version=MapVersion(version=5, base=6))
    with pytest.raises(ValueError, match="base 1"):
        codec.encode_packet(octree, map_version=MapVersion(version=5, base=1))


@given(
    map_version=st.builds(
        MapVersion, *(st.integers(0, 2**bits - 1) for bits in (16, 32, 32)), base=st.just(0),
        weight=st.integers(-(2**63), 2**63 - 1),
    ),
    base=st.integers(0, 2**32 - 1),
    content=st.sampled_from(CONTENTS),
    step=st.sampled_from([0.05, 1e-3, 2.0]),
    level=st.sampled_from([None, 1]),
)  # fmt: skip
def test_header_round_trip(map_version, base, content, step, level):
    octree = quantised(octree_of({(0, 0, 0): [0.1, -0.1]}, resolution=0.3), content, step)
    options = {"packet_format": PacketFormat(content, step, level)}
    header = codec.read_header(codec.encode_packet(octree, map_version=map_version, **options))
    assert (header.kind, header.content, header.compression) == (codec.FULL, content, int(level is not None))
    assert (header.resolution, header.num_classes, header.map_version) == (0.3, 2, map_version)
    assert header.step == (float(np.float32(step)) if content == "int8" else 0.0)
    map_version = MapVersion(**vars(map_version) | {"base": min(base, map_version.version)})
    header = codec.read_header(codec.encode_delta(octree, np.arange(1), map_version=map_version, **options))
    assert (header.kind, header.map_version) == (codec.DELTA, map_version)


def test_int8_below_its_range_is_refused():
    words = _words(*CHAIN, 2)
    packet = _forged(words + b"\x81", content=2, step=0.5, counts=(19, 1, 0, 0))
    expected = np.full(2, -63.5, np.float32).tobytes()
    assert set(cells_of(codec.decode_packet(packet)).values()) == {expected}
    for compression in (0, 1):
        payload = words + b"\x80"
        payload = zstandard.ZstdCompressor().compress(payload) if compression else payload
        with pytest.raises(PacketError, match="int8"):
            codec.decode_packet(_forged(payload, content=2, step=0.5, compression=compression, counts=(19, 1, 0, 0)))


def _words(*words):
    return np.array(words, "<u2").tobytes()


CHAIN = (1,) * 18
"""Child 0 of every node down to depth 18."""


@pytest.mark.parametrize(
    ("payload", "counts"),
    [
        pytest.param(_words(*CHAIN, 2) + bytes(8), (19, 2, 0, 0), id="more values than leaves"),
        pytest.param(_words(*CHAIN, 2), (19, 0, 0, 0), id="fewer values than leaves"),
        pytest.param(_words(*CHAIN, 2) + bytes(4) + b"\1" + bytes(4), (19, 1, 1, 1), id="a mask for a scalar leaf"),
        pytest.param(_words(*CHAIN, 3) + bytes(4), (19, 1, 0, 0), id="no mask for a vector leaf"),
        pytest.param(_words(*CHAIN, 3) + bytes(4) + b"\1", (19, 1, 1, 0), id="fewer values than the mask names"),
        pytest.param(_words(*CHAIN, 3) + bytes(4) + b"\1" + bytes(8), (19, 1, 1, 2), id="more than the mask names"),
        pytest.param(_words(*CHAIN, 3) + bytes(4) + b"\4" + bytes(4), (19, 1, 1, 1), id="a class that is none"),
        pytest.param(_words(*CHAIN, 1), (19, 0, 0, 0), id="an inner node at the finest level"),
        pytest.param(_words(*CHAIN), (18, 0, 0, 0), id="words that end too early"),
        pytest.param(_words(*CHAIN, 2, 0) + bytes(4), (20, 1, 0, 0), id="words that are not reached"),
        pytest.param(_words(0) + bytes(4), (1, 1, 0, 0), id="a value without a leaf"),
        pytest.param(bytes(4), (0, 1, 0, 0), id="a value without a word"),
        pytest.param(_words(2) + bytes(4), (1, 1, 0, 0), id="a leaf of an eighth of the key space"),
        pytest.param(
            _words(*[1] * 7, 3) + bytes(4) + b"\1" + bytes(4), (8, 1, 1, 1), id="a vector leaf of 2^11 cells each side"
        ),
    ],
)
@pytest.mark.parametrize("compression", [0, 1])
def test_malformed_payloads_are_refused_without_allocating_memory(payload, counts, compression):
    if compression:
        payload = zstandard.ZstdCompressor().compress(_coded_payload(payload, counts))
    _refused_without_memory(_forged(payload, counts=counts, compression=compression))


def _refused_without_memory(packet, limit=20_000_000):
    # The first call compiles kernels, which also takes memory.
    codec.decode_packet(codec.encode_packet(octree_of({(0, 0, 0): [1.0, 2.0]})))
    tracemalloc.start()
    try:
        with pytest.raises(PacketError):
            codec.decode_packet(packet)
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("num_classes", [2, 254, 65535])
@pytest.mark.parametrize("compression", [0, 1])
@pytest.mark.parametrize("counts", [*np.diag([2**32 - 1] * 4).tolist(), (2**32 - 1,) * 4])
def test_hostile_counts_allocate_no_memory(counts, compression, num_classes):
    compressor = zstandard.ZstdCompressor()
    unsized = zstandard.ZstdCompressor(write_content_size=False)
    for payload in (compressor.compress(bytes(100)), unsized.compress(bytes(100)), b"", b"garbage"):
        _refused_without_memory(_forged(payload, counts=counts, compression=compression, num_classes=num_classes))


@pytest.mark.parametrize("write_content_size", [True, False])
def test_payload_larger_than_its_counts_is_refused(write_content_size):
    bomb = zstandard.ZstdCompressor(write_content_size=write_content_size).compress(bytes(100_000_000))
    _refused_without_memory(_forged(bomb, counts=(1, 1, 1, 1), compression=1))


def test_frame_with_an_impossible_content_size_allocates_no_memory():
    """A frame of one empty block with a content size of 1 GB in its header."""
    frame = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**30) + b"\1\0\0"
    assert zstandard.get_frame_parameters(frame).content_size == 2**30
    _refused_without_memory(_forged(frame, counts=(0, 2**28, 0, 0), compression=1))


def test_bytes_after_the_compressed_payload_are_refused():
    """The checksum is valid, but the payload is not exactly one zstd frame."""
    octree = octree_of({(0, 0, 0): [1.0, 2.0]})
    packet = codec.encode_packet(octree)
    header = codec.read_header(packet)
    counts = _counts(header)
    payload = packet[codec.HEADER_BYTES :]
    assert codec.decode_packet(_forged(payload, counts=counts, compression=1)).num_cells == 1
    for tail in (b"\0", payload):
        with pytest.raises(PacketError):
            codec.decode_packet(_forged(payload + tail, counts=counts, compression=1))


@settings(max_examples=150, deadline=None)
@given(
    words=st.lists(st.integers(0, 2**16 - 1), max_size=40),
    leaves=st.integers(0, 40),
    masks=st.lists(st.integers(0, 4), max_size=40),
    data=st.data(),
)
def test_any_words_give_an_octree_or_a_packet_error(words, leaves, masks, data):
    own = data.draw(st.sampled_from([sum(mask.bit_count() for mask in masks), data.draw(st.integers(0, 40))]))
    payload = _words(*words) + bytes(4 * leaves) + bytes(masks) + bytes(4 * own)
    try:
        octree = codec.decode_packet(_forged(payload, counts=(len(words), leaves, len(masks), own)))
    except PacketError:
        return
    assert octree.streams().num_leaves <= leaves


@settings(max_examples=200, deadline=None)
@given(octree=octrees(num_classes=2), prune=st.booleans(), data=st.data())
def test_damaged_words_follow_the_format_or_give_a_packet_error(octree, prune, data):
    """Some wrong, additional or missing words deep in a real octree, with a valid checksum."""
    streams = octree.streams(prune=prune)
    words = streams.words.tolist()
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(words)))
        new = data.draw(st.lists(st.sampled_from([0, 1, 2, 3, 0x5555, 0xAAAA, 0xFFFF, 0x9000, 0x4002]), max_size=2))
        words[place : place + data.draw(st.integers(0, 2))] = new
    expected = _naive_cells(words, streams, 2)
    payload = _words(*words) + b"".join(array.tobytes() for array in streams[1:])
    counts = (len(words), *(len(array) for array in streams[1:]))
    packet = _forged(payload, resolution=octree.resolution, counts=counts)
    refusal, decoded = "", None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(octree_module, "MAX_BRICKS", 5000)
        try:
            decoded = codec.decode_packet(packet)
        except PacketError as error:
            refusal = str(error)
    if expected is None:
        assert "do not describe an octree" in refusal
    elif decoded is None:
        assert "more than 5000 bricks" in refusal
    elif decoded.num_cells == len(expected):
        assert cells_of(decoded) == expected
    else:
        # Leaves that are too large to be expanded here.
        assert decoded.num_cells > len(expected)
