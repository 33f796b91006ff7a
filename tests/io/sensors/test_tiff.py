from __future__ import annotations

import io
import random
import struct

import cv2
import numpy as np
import PIL.Image
import pytest

from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import CompressedImage
from octoreplay.io.sensors.images import decode_confidences, decode_depth, decode_labels, encoding_and_size
from support.log_damage import MUTATIONS

HERE = "a.mcap: topic '/depth' at 1.000 s"
RNG = np.random.default_rng(2)
FLOATS = (RNG.random((13, 17)) * 9).astype(np.float32)
MILLIMETRES = (FLOATS * 1000).astype(np.uint16)


def message(data: bytes, form: str = "32FC1; tiff compressed") -> CompressedImage:
    return CompressedImage(0, "camera", form, data)


def by_opencv(pixels: np.ndarray, compression: int = 5) -> bytes:
    """As image_transport's plugin 'compressed' writes it."""
    return cv2.imencode(".tiff", pixels, [cv2.IMWRITE_TIFF_COMPRESSION, compression])[1].tobytes()


def by_pillow(pixels: np.ndarray, **options) -> bytes:
    file = io.BytesIO()
    PIL.Image.fromarray(pixels).save(file, "TIFF", **options)
    return file.getvalue()


@pytest.mark.parametrize(("pixels", "unit"), [(FLOATS, 1.0), (MILLIMETRES, 0.001)])
@pytest.mark.parametrize("compression", [1, 5, 8, 32773, 32946])
def test_depth(pixels, unit, compression):
    image = message(by_opencv(pixels, compression))
    assert encoding_and_size(image, HERE) == ("16UC1" if unit < 1 else "32FC1", (17, 13))
    found, found_unit = decode_depth(image, HERE)
    assert (found.dtype, found_unit) == (pixels.dtype, unit)
    np.testing.assert_array_equal(found, pixels)


@pytest.mark.parametrize("options", [{}, {"compression": "tiff_lzw"}, {"compression": "tiff_adobe_deflate"}])
def test_files_by_pillow(options):
    np.testing.assert_array_equal(decode_depth(message(by_pillow(FLOATS, **options)), HERE)[0], FLOATS)
    ids = (MILLIMETRES % 250).astype(np.uint8)
    np.testing.assert_array_equal(decode_labels(message(by_pillow(ids, **options)), HERE).pixels, ids)
    np.testing.assert_array_equal(decode_confidences(message(by_pillow(ids, **options)), HERE), ids)
    colors = RNG.integers(0, 256, (13, 17, 3)).astype(np.uint8)
    np.testing.assert_array_equal(decode_labels(message(by_pillow(colors, **options)), HERE).pixels, colors)


def test_big_endian_files():
    entries = [(256, 3, 17), (257, 3, 13), (258, 3, 16), (259, 3, 1), (262, 3, 1), (273, 4, 200), (278, 3, 13),
               (279, 4, 17 * 13 * 2)]  # fmt: skip
    head = b"MM\0*" + struct.pack(">IH", 8, len(entries))
    for tag, kind, value in entries:
        head += struct.pack(">HHI", tag, kind, 1) + struct.pack(
            ">HH" if kind == 3 else ">I", *((value, 0)[: 4 // 2 - (kind == 4)])
        )
    data = (head + bytes(4)).ljust(200, b"\0") + MILLIMETRES.astype(">u2").tobytes()
    np.testing.assert_array_equal(decode_depth(message(data), HERE)[0], MILLIMETRES)


@pytest.mark.parametrize(
    "data",
    [
        by_opencv(np.zeros((4, 4, 3), np.uint16)), by_opencv(FLOATS.astype(np.float64)), b"II*\0",
        b"II*\0" + b"\xff" * 40,
        by_pillow(MILLIMETRES.astype(np.uint8), compression="jpeg"),
        by_pillow(MILLIMETRES > 3000), by_opencv(FLOATS, 1)[:300],
    ],
)  # fmt: skip
def test_other_pixels_lossy_compression_and_cut_files(data):
    with pytest.raises(DamagedMessageError, match="image cannot be decoded"):
        decode_depth(message(data), HERE)


def test_damaged_files_write_nothing_to_the_terminal(capfd):
    rng, outcomes = random.Random(7), set()
    files = [by_opencv(FLOATS, 1), by_opencv(MILLIMETRES, 5), by_pillow(FLOATS, compression="tiff_adobe_deflate")]
    for _ in range(600):
        data = rng.choice(MUTATIONS)(rng.choice(files), rng)
        try:
            assert decode_depth(message(data), HERE, depth_unit=1.0)[0].ndim == 2
            outcomes.add("read")
        except DamagedMessageError:
            outcomes.add("damaged")
    assert outcomes == {"read", "damaged"}
    assert capfd.readouterr() == ("", "")


def test_a_declared_size_takes_no_memory(monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("made room"))
    data = bytearray(by_pillow(FLOATS))
    for tag in (256, 257):
        at = (
            data.index(struct.pack("<HHI", tag, 4, 1))
            if struct.pack("<HHI", tag, 4, 1) in data
            else data.index(struct.pack("<HHI", tag, 3, 1))
        )
        data[at : at + 12] = struct.pack("<HHII", tag, 4, 1, 8000)
    with pytest.raises(DamagedMessageError, match="image cannot be decoded"):
        decode_depth(message(bytes(data)), HERE)
