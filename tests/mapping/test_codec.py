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
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree, leaf_list, leaf_values, octree_from_streams
from octree_factory import brick_code, cells_of, cube, octree_of

LIMIT = storage.KEY_OFFSET

VALUES = st.sampled_from([0.0, -5.0, 5.0, -0.3, 1.0, 1e-30, -3e38, float(np.float32(0.1))])


@st.composite
def octrees(draw, num_classes=None):
    """Octrees of single cells and cubes, near the origin (both signs) and at the ends of the key space."""
    num_classes = num_classes or draw(st.sampled_from([1, 2, 5, 9, 20]))
    corners = st.sampled_from([-LIMIT, -LIMIT + 64, -64, -17, -8, -1, 0, 3, 8, 40, LIMIT - 64])
    cells = {}
    for _ in range(draw(st.integers(0, 6))):
        edge = draw(st.sampled_from([1, 1, 2, 3, 4, 8, 16]))
        corner = [draw(corners) for _ in range(3)]
        # As many values as classes, or a few that several classes share.
        palette = [draw(VALUES) for _ in range(draw(st.integers(1, 3)))]
        values = [draw(VALUES if draw(st.booleans()) else st.sampled_from(palette)) for _ in range(num_classes)]
        values = [palette[0]] * num_classes if draw(st.booleans()) else values
        cells.update(cube(corner, edge, values))
    return octree_of(cells, num_classes=num_classes, resolution=draw(st.sampled_from([0.25, 0.3, 1e-3, 7.0])))


@settings(max_examples=60, deadline=None)
@given(octree=octrees(), compress=st.booleans(), prune=st.booleans())
def test_a_packet_gives_the_map_back_bit_for_bit(octree, compress, prune):
    packet = codec.encode_packet(octree, compress=compress, prune=prune)
    decoded = codec.decode_packet(packet)
    assert (decoded.resolution, decoded.num_classes) == (octree.resolution, octree.num_classes)
    assert cells_of(decoded) == cells_of(octree)
    # The octree is canonical, so the same map gives the same bytes, however it was pruned before.
    assert codec.encode_packet(decoded) == codec.encode_packet(octree)


@settings(max_examples=60, deadline=None)
@given(octree=octrees(), prune=st.booleans())
def test_the_streams_read_as_the_format_says(octree, prune):
    streams = octree.streams(prune=prune)
    assert _naive_cells(streams.words.tolist(), streams, octree.num_classes) == cells_of(octree)


def _naive_cells(words, streams, num_classes):
    """{key: bytes of its values} read recursively, as docs/packet-format.md says it; None for words that are no octree.

    Leaves larger than 32 cells are left out.
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
def test_a_leaf_holds_the_value_of_most_classes_and_those_that_differ(octree):
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
def test_a_delta_replaces_the_bricks_that_it_holds(before, after, data):
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


def test_the_corners_of_the_key_space():
    ends = (-LIMIT, LIMIT - 1)
    cells = {(x, y, z): [float(x > 0), float(y > 0) + 2 * (z > 0)] for x in ends for y in ends for z in ends}
    octree = octree_of(cells)
    assert set(cells_of(octree)) == set(cells)
    assert cells_of(codec.decode_packet(codec.encode_packet(octree))) == cells_of(octree)


def test_an_empty_map():
    octree = SemanticOctree(0.2, 3)
    packet = codec.encode_packet(octree, compress=False)
    assert len(packet) == codec.HEADER_BYTES
    assert codec.decode_packet(packet).num_bricks == 0
    assert codec.decode_packet(codec.encode_packet(octree)).num_classes == 3


def test_bricks_without_a_known_cell_take_no_words():
    octree = octree_of({(0, 0, 0): [1.0, 2.0]})
    packet = codec.encode_packet(octree)
    octree.find_or_add(np.array([0, 1, 77], np.int64))
    assert codec.encode_packet(octree) == packet
    octree.bricks.known[:] = 0
    assert octree.streams().words.size == octree.streams(prune=False).words.size == 0


def test_equal_maps_are_equal_bytes_whatever_the_sign_of_0_and_the_order_of_bricks():
    cells = cube((-9, 0, 3), 12, [0.0, 1.0]) | cube((0, 0, 0), 4, [0.0, 0.0]) | {(50, 0, 0): [0.0, 0.0]}
    packet = codec.encode_packet(octree_of(cells))
    signed = {key: [-value if value == 0 else value for value in values] for key, values in reversed(cells.items())}
    assert codec.encode_packet(octree_of(signed)) == packet


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("tolerance", [0.0, 0.5])
def test_values_that_are_no_numbers_keep_their_place(value, tolerance):
    """They never come from scans, but may from a packet: nothing else may change, and nothing is written outside."""
    octree = SemanticOctree(0.25, 3)
    octree.find_or_add(np.arange(64))
    masks = np.repeat([0, 0x0001_0507_0203_0004, 0], [22, 21, 21]).astype(np.uint64)[:, None]
    has_block = np.repeat([True, False], [43, 21])
    octree.raise_bricks(np.arange(64), masks, np.full(64, storage.ALL_CELLS), has_block)
    for array in (octree.bricks.values, octree.bricks.rows):
        array[:] = value
    streams = octree.streams(tolerance=tolerance)
    decoded = octree_from_streams(streams, 0.25, 3)
    assert decoded.num_cells == octree.num_cells
    assert np.array_equal(streams.values, np.full_like(streams.values, value), equal_nan=True)
    assert streams.masks.size == 0
    assert len(cells_of(decoded)) == 64 * 64


def test_the_bytes_by_hand():
    """A root with a single cell at key (0, 0, 0): child 7 of the root, then child 0 of each; one vector leaf."""
    packet = codec.encode_packet(octree_of({(0, 0, 0): [1.5, -2.0]}), compress=False)
    words = [codec_state << (2 * child) for codec_state, child in [(1, 7)] + [(1, 0)] * 17 + [(3, 0)]]
    payload = struct.pack("<19HfBf", *words, 1.5, 0b10, -2.0)
    fields = (b"OCTM", 2, 0, 0, 0, 2, 0, 0.25, 19, 1, 1, 1, len(payload))
    checksum = zlib.crc32(payload, zlib.crc32(struct.pack("<4sBBBBHHdIIIIII", *fields, 0)))
    assert packet == struct.pack("<4sBBBBHHdIIIIII", *fields, checksum) + payload


def test_tolerance_merges_within_its_bound():
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


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("kind", ["packet", "delta"])
def test_every_single_damaged_byte_is_seen(sample, kind, compress):
    packet = codec.encode_packet(sample, compress=compress)
    if kind == "delta":
        packet = codec.encode_delta(sample, np.arange(sample.num_bricks), compress=compress)
    for place in range(len(packet)):
        for flip in (0x01, 0x80, 0xFF):
            damaged = bytearray(packet)
            damaged[place] ^= flip
            with pytest.raises(PacketError):
                codec.read_header(bytes(damaged))
    _refused(bytes([*packet[:-1], packet[-1] ^ 1]), sample)


@pytest.mark.parametrize("compress", [True, False])
def test_cut_and_longer_packets_are_refused(sample, compress):
    packet = codec.encode_packet(sample, compress=compress)
    for length in range(len(packet)):
        with pytest.raises(PacketError):
            codec.decode_packet(packet[:length])
    for tail in (b"\0", packet, b"OCTM"):
        _refused(packet + tail, sample)


def test_kinds_are_not_mixed_up(sample):
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


def _forged(payload, *, version=2, kind=0, content=0, compression=0, num_classes=2, zero=0, resolution=0.25, counts):
    """A packet with a good checksum and any content."""
    fields = (b"OCTM", version, kind, content, compression, num_classes, zero, resolution, *counts, len(payload))
    checksum = zlib.crc32(payload, zlib.crc32(struct.pack("<4sBBBBHHdIIIIII", *fields, 0)))
    return struct.pack("<4sBBBBHHdIIIIII", *fields, checksum) + payload


@pytest.mark.parametrize(
    "fields",
    [
        {"version": 1}, {"version": 3}, {"kind": 2}, {"content": 1}, {"compression": 2}, {"num_classes": 0},
        {"num_classes": 255}, {"zero": 1},
        {"resolution": 0.0}, {"resolution": -0.25}, {"resolution": float("nan")}, {"resolution": float("inf")},
    ],
    ids=str,
)  # fmt: skip
def test_unknown_headers_are_refused(fields):
    good = _forged(b"", counts=(0, 0, 0, 0))
    assert codec.decode_packet(good).num_bricks == 0
    with pytest.raises(PacketError):
        codec.decode_packet(_forged(b"", counts=(0, 0, 0, 0), **fields))


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
def test_payloads_that_are_no_octree_are_refused_and_take_no_memory(payload, counts, compression):
    if compression:
        payload = zstandard.ZstdCompressor().compress(payload)
    _refused_without_memory(_forged(payload, counts=counts, compression=compression))


def _refused_without_memory(packet, limit=20_000_000):
    # Compiling takes memory, too.
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
def test_hostile_counts_take_no_memory(counts, compression, num_classes):
    compressor = zstandard.ZstdCompressor()
    unsized = zstandard.ZstdCompressor(write_content_size=False)
    for payload in (compressor.compress(bytes(100)), unsized.compress(bytes(100)), b"", b"garbage"):
        _refused_without_memory(_forged(payload, counts=counts, compression=compression, num_classes=num_classes))


@pytest.mark.parametrize("write_content_size", [True, False])
def test_a_payload_that_unpacks_to_more_than_its_counts_is_refused(write_content_size):
    bomb = zstandard.ZstdCompressor(write_content_size=write_content_size).compress(bytes(100_000_000))
    _refused_without_memory(_forged(bomb, counts=(1, 1, 1, 1), compression=1))


def test_bytes_behind_the_compressed_payload_are_refused():
    """The checksum holds, yet the payload is not the one zstd frame that it should be."""
    octree = octree_of({(0, 0, 0): [1.0, 2.0]})
    packet = codec.encode_packet(octree)
    header = codec.read_header(packet)
    counts = (header.num_words, header.num_leaves, header.num_vectors, header.num_own_values)
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
def test_damaged_words_give_what_the_format_says_or_a_packet_error(octree, prune, data):
    """A few wrong words, or some too many or missing, deep in a real octree; the checksum holds."""
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
        assert "no octree" in refusal
    elif decoded is None:
        assert "more space" in refusal
    elif decoded.num_cells == len(expected):
        assert cells_of(decoded) == expected
    else:
        # Leaves that are too large to be written out here.
        assert decoded.num_cells > len(expected)
