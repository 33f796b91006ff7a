from __future__ import annotations

import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.errors import PacketError
from octoreplay.replay.exchange.acknowledgement import Possession, decode_acknowledgement, encode_acknowledgement

U16, U32 = st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1)
ENTRIES = st.lists(st.builds(Possession, U16, U32, st.none() | U32), max_size=5).map(tuple)
SAMPLE = (Possession(1, 2, 3), Possession(4, 5, None))


@given(ENTRIES)
def test_encode_decode_round_trip(entries):
    assert decode_acknowledgement(encode_acknowledgement(entries)) == entries


def test_bytes_follow_the_documented_format():
    body = b"OCTA" + bytes([1, 0]) + struct.pack("<H", 2)
    body += struct.pack("<HIBI", 1, 2, 1, 3) + struct.pack("<HIBI", 4, 5, 0, 0)
    assert encode_acknowledgement(SAMPLE) == body + struct.pack("<I", zlib.crc32(body))


def test_flipped_bits_and_cuts_are_refused():
    data = encode_acknowledgement(SAMPLE)
    for place in range(8 * len(data)):
        damaged = bytearray(data)
        damaged[place // 8] ^= 1 << place % 8
        with pytest.raises(PacketError):
            decode_acknowledgement(bytes(damaged))
    for length in range(len(data)):
        with pytest.raises(PacketError):
            decode_acknowledgement(data[:length])


@pytest.mark.parametrize(
    ("place", "value"), [(4, 2), (5, 1), (6, 3), (14, 2)], ids=["version", "zero", "count", "has a map"]
)
def test_unknown_formats_are_refused(place, value):
    body = bytearray(encode_acknowledgement(SAMPLE)[:-4])
    body[place] = value
    with pytest.raises(PacketError, match="of an unknown format version"):
        decode_acknowledgement(bytes(body) + struct.pack("<I", zlib.crc32(body)))
