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
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree
from octree_factory import brick_code, cells_of, cube, octree_of

LIMIT = storage.KEY_OFFSET

VALUES = st.sampled_from([0.0, -5.0, 5.0, -0.3, 1.0, 1e-30, -3e38, float(np.float32(0.1))])


@st.composite
def octrees(draw, num_classes=None):
    """Octrees of single cells and cubes, near the origin (both signs) and at the ends of the key space."""
    num_classes = num_classes or draw(st.sampled_from([1, 2, 5]))
    corners = st.sampled_from([-LIMIT, -LIMIT + 64, -64, -17, -8, -1, 0, 3, 8, 40, LIMIT - 64])
    cells = {}
    for _ in range(draw(st.integers(0, 6))):
        edge = draw(st.sampled_from([1, 1, 2, 3, 4, 8, 16]))
        corner = [draw(corners) for _ in range(3)]
        equal = draw(st.booleans())
        values = [draw(VALUES)] * num_classes if equal else [draw(VALUES) for _ in range(num_classes)]
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
    assert (streams.scalars.tolist(), streams.vectors.shape) == ([-5.0], (0, 2))
    assert codec.decode_packet(codec.encode_packet(octree)).num_cells == 64**3
    hit = octree_of(cube((64, 0, -32), 32, [1.0, -0.3]))
    streams = hit.streams()
    assert (streams.scalars.size, streams.vectors.tolist()) == (0, [[1.0, pytest.approx(-0.3)]])
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


def test_the_bytes_by_hand():
    """A root with a single cell at key (0, 0, 0): child 7 of the root, then child 0 of each; one vector."""
    packet = codec.encode_packet(octree_of({(0, 0, 0): [1.5, -2.0]}), compress=False)
    words = [codec_state << (2 * child) for codec_state, child in [(1, 7)] + [(1, 0)] * 17 + [(3, 0)]]
    payload = struct.pack("<19H2f", *words, 1.5, -2.0)
    fields = (b"OCTM", 1, 0, 0, 0, 2, 0, 0.25, 19, 0, 1, len(payload))
    checksum = zlib.crc32(payload, zlib.crc32(struct.pack("<4sBBBBHHdIIIII", *fields, 0)))
    assert packet == struct.pack("<4sBBBBHHdIIIII", *fields, checksum) + payload


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


def _forged(payload, *, version=1, kind=0, content=0, compression=0, num_classes=2, zero=0, resolution=0.25, counts):
    """A packet with a good checksum and any content."""
    fields = (b"OCTM", version, kind, content, compression, num_classes, zero, resolution, *counts, len(payload))
    checksum = zlib.crc32(payload, zlib.crc32(struct.pack("<4sBBBBHHdIIIII", *fields, 0)))
    return struct.pack("<4sBBBBHHdIIIII", *fields, checksum) + payload


@pytest.mark.parametrize(
    "fields",
    [
        {"version": 0}, {"version": 2}, {"kind": 2}, {"content": 1}, {"compression": 2}, {"num_classes": 0},
        {"num_classes": 255}, {"zero": 1},
        {"resolution": 0.0}, {"resolution": -0.25}, {"resolution": float("nan")}, {"resolution": float("inf")},
    ],
    ids=str,
)  # fmt: skip
def test_unknown_headers_are_refused(fields):
    good = _forged(b"", counts=(0, 0, 0))
    assert codec.decode_packet(good).num_bricks == 0
    with pytest.raises(PacketError):
        codec.decode_packet(_forged(b"", counts=(0, 0, 0), **fields))


def _words(*words):
    return np.array(words, "<u2").tobytes()


CHAIN = (1,) * 18
"""Child 0 of every node down to depth 18."""


@pytest.mark.parametrize(
    ("payload", "counts"),
    [
        pytest.param(_words(*CHAIN, 2) + np.float32(1).tobytes(), (19, 2, 0), id="more scalars than leaves"),
        pytest.param(_words(*CHAIN, 2), (19, 0, 0), id="fewer scalars than leaves"),
        pytest.param(_words(*CHAIN, 2) + bytes(8), (19, 0, 1), id="a vector for a scalar leaf"),
        pytest.param(_words(*CHAIN, 3) + bytes(4), (19, 1, 0), id="a scalar for a vector leaf"),
        pytest.param(_words(*CHAIN, 1), (19, 0, 0), id="an inner node at the finest level"),
        pytest.param(_words(*CHAIN), (18, 0, 0), id="words that end too early"),
        pytest.param(_words(*CHAIN, 2, 0) + bytes(4), (20, 1, 0), id="words that are not reached"),
        pytest.param(_words(0) + bytes(4), (1, 1, 0), id="a scalar without a leaf"),
        pytest.param(bytes(4), (0, 1, 0), id="a scalar without a word"),
        pytest.param(_words(2) + bytes(4), (1, 1, 0), id="a leaf of an eighth of the key space"),
        pytest.param(_words(*[1] * 7, 3) + bytes(8), (8, 0, 1), id="a vector leaf of 2^11 cells each side"),
    ],
)
@pytest.mark.parametrize("compression", [0, 1])
def test_payloads_that_are_no_octree_are_refused_and_take_no_memory(payload, counts, compression):
    if compression:
        payload = zstandard.ZstdCompressor().compress(payload)
    _refused_without_memory(_forged(payload, counts=counts, compression=compression))


def _refused_without_memory(packet, limit=20_000_000):
    tracemalloc.start()
    try:
        with pytest.raises(PacketError):
            codec.decode_packet(packet)
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("num_classes", [2, 254, 65535])
@pytest.mark.parametrize("compression", [0, 1])
@pytest.mark.parametrize("counts", [(2**32 - 1, 0, 0), (0, 2**32 - 1, 0), (0, 0, 2**32 - 1), (2**32 - 1,) * 3])
def test_hostile_counts_take_no_memory(counts, compression, num_classes):
    compressor = zstandard.ZstdCompressor()
    unsized = zstandard.ZstdCompressor(write_content_size=False)
    for payload in (compressor.compress(bytes(100)), unsized.compress(bytes(100)), b"", b"garbage"):
        _refused_without_memory(_forged(payload, counts=counts, compression=compression, num_classes=num_classes))


@pytest.mark.parametrize("write_content_size", [True, False])
def test_a_payload_that_unpacks_to_more_than_its_counts_is_refused(write_content_size):
    bomb = zstandard.ZstdCompressor(write_content_size=write_content_size).compress(bytes(100_000_000))
    _refused_without_memory(_forged(bomb, counts=(1, 1, 1), compression=1))


def test_bytes_behind_the_compressed_payload_are_refused():
    """The checksum holds, yet the payload is not the one zstd frame that it should be."""
    octree = octree_of({(0, 0, 0): [1.0, 2.0]})
    packet = codec.encode_packet(octree)
    header = codec.read_header(packet)
    counts = (header.num_words, header.num_scalars, header.num_vectors)
    payload = packet[codec.HEADER_BYTES :]
    assert codec.decode_packet(_forged(payload, counts=counts, compression=1)).num_cells == 1
    for tail in (b"\0", payload):
        with pytest.raises(PacketError):
            codec.decode_packet(_forged(payload + tail, counts=counts, compression=1))


@settings(max_examples=150, deadline=None)
@given(
    words=st.lists(st.integers(0, 2**16 - 1), max_size=40),
    scalars=st.integers(0, 40),
    vectors=st.integers(0, 40),
)
def test_any_words_give_an_octree_or_a_packet_error(words, scalars, vectors):
    payload = _words(*words) + bytes(4 * scalars + 8 * vectors)
    try:
        octree = codec.decode_packet(_forged(payload, counts=(len(words), scalars, vectors)))
    except PacketError:
        return
    assert octree.streams().num_leaves <= scalars + vectors
