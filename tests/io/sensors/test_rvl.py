from __future__ import annotations

import random
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import CompressedImage
from octoreplay.io.sensors.images import decode_depth, encoding_and_size
from octoreplay.io.sensors.rvl import decode_rvl
from support.log_damage import MUTATIONS
from support.long_suite import examples
from support.rvl_writer import decode_naively, encode_rvl, nibbles_of, words_of

HERE = "a.mcap: topic '/depth' at 1.000 s"
HEADER = struct.pack("<iff", 0, 0.0, 0.0)
STREAM = bytes.fromhex("2df38a238b8b3c211bbcfd2e1431ffff00000040")
IMAGE = np.array([[0, 0, 1000, 1001, 990], [0, 40000, 65535, 1, 0], [3, 0, 0, 0, 0]], np.uint16)


def message(content: bytes, form: str = "16UC1; compressedDepth rvl") -> CompressedImage:
    return CompressedImage(0, "camera", form, content)


def sized(stream: bytes, width: int, height: int) -> bytes:
    return HEADER + struct.pack("<ii", width, height) + stream


def test_the_stream_of_another_encoder():
    """The stream that pyrvl 0.0.1, the C++ encoder of compressed_depth_image_transport, writes for this image."""
    assert decode_rvl(STREAM, 15).tolist() == IMAGE.reshape(-1).tolist()
    assert encode_rvl(IMAGE) == STREAM


@examples(200)
@given(
    st.integers(1, 9), st.integers(1, 9), st.sampled_from([0.0, 0.3, 1.0]), st.sampled_from([4, 900, 65535]),
    st.integers(0, 1 << 30),
)  # fmt: skip
def test_any_image_is_decoded_exactly(height, width, share, largest, seed):
    rng = np.random.default_rng(seed)
    image = (rng.integers(0, largest, (height, width), endpoint=True) * (rng.random((height, width)) < share)).astype(
        "u2"
    )
    found, unit = decode_depth(message(sized(encode_rvl(image), width, height)), HERE)
    assert (found.dtype, unit) == (np.uint16, 0.001)
    np.testing.assert_array_equal(found, image)


def test_every_stream_is_read_as_the_naive_decoder_reads_it():
    rng, outcomes = random.Random(3), {True: 0, False: 0}
    for _ in range(3000):
        if rng.random() < 0.5:
            data, size = rng.choice(MUTATIONS)(STREAM, rng), rng.choice([15, 15, 15, 14, 1, 40])
        else:
            numbers = [rng.choice([0, 1, 1, 2, 3, 7, 8, 70, 1 << 31]) for _ in range(rng.randrange(1, 12))]
            data, size = words_of(n for number in numbers for n in nibbles_of(number)), rng.randrange(1, 9)
        expected = decode_naively(data, size)
        outcomes[expected is not None] += 1
        if expected is None:
            with pytest.raises(ValueError, match="RVL stream"):
                decode_rvl(data, size)
        else:
            assert decode_rvl(data, size).tolist() == expected.tolist()
    assert min(outcomes.values()) > 300


def test_inverse_depth_in_rvl():
    values = np.array([[0, 20, 40], [50, 60, 70]], np.uint16)
    content = struct.pack("<iff", 0, 100.0, 2.0) + struct.pack("<ii", 3, 2) + encode_rvl(values)
    image = message(content, "32FC1; compressedDepth rvl")
    assert encoding_and_size(image, HERE) == ("32FC1", (3, 2))
    found, unit = decode_depth(image, HERE)
    assert (found.dtype, unit) == (np.float32, 1.0)
    np.testing.assert_allclose(found, np.where(values > 0, 100 / (values - 2.0), np.nan), rtol=1e-6)


@pytest.mark.parametrize(
    "content",
    [
        HEADER, HEADER + b"\5\0\0\0", sized(STREAM, 0, 3), sized(STREAM, -5, -3), sized(STREAM, 1 << 30, 1 << 30),
        sized(STREAM, 8000, 8000), sized(STREAM, 5, 4), sized(STREAM[:-8], 5, 3), sized(b"", 5, 3),
        sized(b"\xff" * 40, 5, 3),
    ],
)  # fmt: skip
def test_damaged_streams_and_sizes(content):
    with pytest.raises(DamagedMessageError, match=r"is empty|image cannot be decoded"):
        decode_depth(message(content), HERE)
