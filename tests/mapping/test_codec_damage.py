"""Map packets that are damaged, malformed or of other versions."""

from __future__ import annotations

import struct
import tracemalloc

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.errors import PacketError
from octoreplay.mapping import codec
from octoreplay.mapping import octree as octree_module
from octoreplay.mapping.codec import MapVersion, PacketFormat
from octoreplay.mapping.quantise import CONTENTS, quantised
from support.long_suite import examples
from support.octree_factory import cells_of, cube, octree_of
from support.packet_format import CHAIN, coded_payload, counts_of, forged, naive_cells, octrees, words_of


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
    assert codec.decode_packet(forged(b"", **good)).num_bricks == 0
    with pytest.raises(PacketError):
        codec.decode_packet(forged(b"", **good | fields))


def test_packets_of_other_versions_are_refused_with_their_version():
    with pytest.raises(PacketError, match="format version 2, this octoreplay reads version 3"):
        codec.read_header(b"OCTM\x02" + bytes(39))
    with pytest.raises(PacketError, match="cut: 67 bytes"):
        codec.read_header(forged(b"", counts=(0, 0, 0, 0))[:-1])
    for data in (b"", b"OCT", b"OCTM", b"MTCO\x03" + bytes(63)):
        with pytest.raises(PacketError, match="not a map packet"):
            codec.read_header(data)


def test_base_of_a_delta_is_not_later_than_its_version():
    octree = octree_of({(0, 0, 0): [1.0, 2.0]})
    packet = forged(b"", kind=1, map_version=(1, 0, 5, 5), counts=(0, 0, 0, 0))
    assert codec.read_header(packet).map_version == MapVersion(origin=1, version=5, base=5)
    codec.apply_delta(octree, packet)
    with pytest.raises(PacketError, match="base"):
        codec.apply_delta(octree, forged(b"", kind=1, map_version=(1, 0, 5, 6), counts=(0, 0, 0, 0)))
    with pytest.raises(ValueError, match="base 6"):
        codec.encode_delta(octree, np.arange(1), map_version=MapVersion(version=5, base=6))
    with pytest.raises(ValueError, match="base 1"):
        codec.encode_packet(octree, map_version=MapVersion(version=5, base=1))


@examples(100)
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
    words = words_of(*CHAIN, 2)
    packet = forged(words + b"\x81", content=2, step=0.5, counts=(19, 1, 0, 0))
    expected = np.full(2, -63.5, np.float32).tobytes()
    assert set(cells_of(codec.decode_packet(packet)).values()) == {expected}
    for compression in (0, 1):
        payload = words + b"\x80"
        payload = zstandard.ZstdCompressor().compress(payload) if compression else payload
        with pytest.raises(PacketError, match="int8"):
            codec.decode_packet(forged(payload, content=2, step=0.5, compression=compression, counts=(19, 1, 0, 0)))


@pytest.mark.parametrize(
    ("payload", "counts"),
    [
        pytest.param(words_of(*CHAIN, 2) + bytes(8), (19, 2, 0, 0), id="more values than leaves"),
        pytest.param(words_of(*CHAIN, 2), (19, 0, 0, 0), id="fewer values than leaves"),
        pytest.param(words_of(*CHAIN, 2) + bytes(4) + b"\1" + bytes(4), (19, 1, 1, 1), id="a mask for a scalar leaf"),
        pytest.param(words_of(*CHAIN, 3) + bytes(4), (19, 1, 0, 0), id="no mask for a vector leaf"),
        pytest.param(words_of(*CHAIN, 3) + bytes(4) + b"\1", (19, 1, 1, 0), id="fewer values than the mask names"),
        pytest.param(words_of(*CHAIN, 3) + bytes(4) + b"\1" + bytes(8), (19, 1, 1, 2), id="more than the mask names"),
        pytest.param(words_of(*CHAIN, 3) + bytes(4) + b"\4" + bytes(4), (19, 1, 1, 1), id="a class that is none"),
        pytest.param(words_of(*CHAIN, 1), (19, 0, 0, 0), id="an inner node at the finest level"),
        pytest.param(words_of(*CHAIN), (18, 0, 0, 0), id="words that end too early"),
        pytest.param(words_of(*CHAIN, 2, 0) + bytes(4), (20, 1, 0, 0), id="words that are not reached"),
        pytest.param(words_of(0) + bytes(4), (1, 1, 0, 0), id="a value without a leaf"),
        pytest.param(bytes(4), (0, 1, 0, 0), id="a value without a word"),
        pytest.param(words_of(2) + bytes(4), (1, 1, 0, 0), id="a leaf of an eighth of the key space"),
        pytest.param(
            words_of(*[1] * 7, 3) + bytes(4) + b"\1" + bytes(4),
            (8, 1, 1, 1),
            id="a vector leaf of 2^11 cells each side",
        ),
    ],
)
@pytest.mark.parametrize("compression", [0, 1])
def test_malformed_payloads_are_refused_without_allocating_memory(payload, counts, compression):
    if compression:
        payload = zstandard.ZstdCompressor().compress(coded_payload(payload, counts))
    _refused_without_memory(forged(payload, counts=counts, compression=compression))


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
        _refused_without_memory(forged(payload, counts=counts, compression=compression, num_classes=num_classes))


@pytest.mark.parametrize("write_content_size", [True, False])
def test_payload_larger_than_its_counts_is_refused(write_content_size):
    bomb = zstandard.ZstdCompressor(write_content_size=write_content_size).compress(bytes(100_000_000))
    _refused_without_memory(forged(bomb, counts=(1, 1, 1, 1), compression=1))


def test_frame_with_an_impossible_content_size_allocates_no_memory():
    """A frame of one empty block with a content size of 1 GB in its header."""
    frame = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**30) + b"\1\0\0"
    assert zstandard.get_frame_parameters(frame).content_size == 2**30
    _refused_without_memory(forged(frame, counts=(0, 2**28, 0, 0), compression=1))


def test_bytes_after_the_compressed_payload_are_refused():
    """The checksum is valid, but the payload is not exactly one zstd frame."""
    octree = octree_of({(0, 0, 0): [1.0, 2.0]})
    packet = codec.encode_packet(octree)
    header = codec.read_header(packet)
    counts = counts_of(header)
    payload = packet[codec.HEADER_BYTES :]
    assert codec.decode_packet(forged(payload, counts=counts, compression=1)).num_cells == 1
    for tail in (b"\0", payload):
        with pytest.raises(PacketError):
            codec.decode_packet(forged(payload + tail, counts=counts, compression=1))


@examples(150)
@given(
    words=st.lists(st.integers(0, 2**16 - 1), max_size=40),
    leaves=st.integers(0, 40),
    masks=st.lists(st.integers(0, 4), max_size=40),
    data=st.data(),
)
def test_any_words_give_an_octree_or_a_packet_error(words, leaves, masks, data):
    own = data.draw(st.sampled_from([sum(mask.bit_count() for mask in masks), data.draw(st.integers(0, 40))]))
    payload = words_of(*words) + bytes(4 * leaves) + bytes(masks) + bytes(4 * own)
    try:
        octree = codec.decode_packet(forged(payload, counts=(len(words), leaves, len(masks), own)))
    except PacketError:
        return
    assert octree.streams().num_leaves <= leaves


@examples(200)
@given(octree=octrees(num_classes=2), prune=st.booleans(), data=st.data())
def test_damaged_words_follow_the_format_or_give_a_packet_error(octree, prune, data):
    """Some wrong, additional or missing words deep in a real octree, with a valid checksum."""
    streams = octree.streams(prune=prune)
    words = streams.words.tolist()
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(words)))
        new = data.draw(st.lists(st.sampled_from([0, 1, 2, 3, 0x5555, 0xAAAA, 0xFFFF, 0x9000, 0x4002]), max_size=2))
        words[place : place + data.draw(st.integers(0, 2))] = new
    expected = naive_cells(words, streams, 2)
    payload = words_of(*words) + b"".join(array.tobytes() for array in streams[1:])
    counts = (len(words), *(len(array) for array in streams[1:]))
    packet = forged(payload, resolution=octree.resolution, counts=counts)
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
