from __future__ import annotations

import dataclasses
import io
import struct
import zlib

import cv2
import numpy as np
import PIL.Image
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.errors import InputError
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import CompressedImage, Image, convert
from octoreplay.io.sensors.images import (
    DEPTH_ENCODINGS,
    LABEL_ENCODINGS,
    confidences,
    decode_confidences,
    decode_depth,
    decode_labels,
    encoding_and_size,
)
from support.log_factory import ros2
from support.long_suite import examples

HERE = "a.mcap: topic '/x' at 1.000 s"
KINDS = {
    "mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "16SC1": "i2", "32SC1": "i4", "32FC1": "f4",
}  # fmt: skip
COLOR_ORDERS = {
    "rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2, 3], "bgra8": [2, 1, 0, 3], "8UC3": [2, 1, 0],
    "8UC4": [2, 1, 0, 3],
}  # fmt: skip


def raw(pixels: np.ndarray, encoding: str, **options) -> Image:
    return convert("sensor_msgs/msg/Image", ros2.image(0, pixels, encoding, **options))


def encoded(data: bytes, form: str = "png") -> CompressedImage:
    return CompressedImage(0, "camera", form, data)


def pixels_of(kind: str, height: int, width: int) -> np.ndarray:
    count = height * width
    if kind == "f4":
        values = np.linspace(0.1, 9.9, count).astype("f4")
        values[0] = np.nan
        return values.reshape(height, width)
    limits = np.iinfo(kind)
    return np.linspace(limits.min, limits.max, count).astype(kind).reshape(height, width)


def colors(height: int = 5, width: int = 6) -> np.ndarray:
    """Pixels with different values of red, green, blue and alpha."""
    return (
        np.random.default_rng(3).permutation(np.arange(height * width * 4) % 251).astype("u1").reshape(height, width, 4)
    )


def png(pixels: np.ndarray) -> bytes:
    """A PNG by Pillow; the package decodes with OpenCV."""
    return saved(PIL.Image.fromarray(pixels), "PNG")


def saved(image: PIL.Image.Image, form: str, **options) -> bytes:
    file = io.BytesIO()
    image.save(file, form, **options)
    return file.getvalue()


def png_head(width: int, height: int) -> bytes:
    """PNG whose header gives a size and that holds almost no data."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    body = chunk(b"IDAT", zlib.compress(b"\0" * 100))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + body + chunk(b"IEND", b"")


# --- raw images ------------------------------------------------------------------------------------------------------


@given(st.sampled_from(sorted(DEPTH_ENCODINGS)), st.integers(1, 7), st.integers(1, 9), st.integers(0, 5), st.booleans())
def test_depth_is_decoded_exactly(encoding, height, width, padding, big_endian):
    pixels = pixels_of(KINDS[encoding], height, width)
    image, unit = decode_depth(raw(pixels, encoding, padding=padding, big_endian=big_endian), HERE)
    assert unit == {"u2": 0.001, "f4": 1.0}[KINDS[encoding]]
    assert image.dtype == np.dtype(KINDS[encoding])
    assert image.dtype.isnative
    assert image.flags.c_contiguous
    assert image.flags.aligned
    np.testing.assert_array_equal(image, pixels)


@given(st.sampled_from(sorted(set(LABEL_ENCODINGS) & set(KINDS))), st.integers(0, 5), st.booleans())
def test_labels_are_decoded_exactly(encoding, padding, big_endian):
    pixels = pixels_of(KINDS[encoding], 5, 6)
    labels = decode_labels(raw(pixels, encoding, padding=padding, big_endian=big_endian), HERE)
    assert labels.pixels.dtype == pixels.dtype
    assert not labels.is_color
    assert not labels.is_lossy
    np.testing.assert_array_equal(labels.pixels, pixels)


@pytest.mark.parametrize("encoding", sorted(COLOR_ORDERS))
@pytest.mark.parametrize("padding", [0, 3])
def test_colours_are_rgb_for_every_channel_order(encoding, padding):
    stored = np.ascontiguousarray(colors()[..., COLOR_ORDERS[encoding]])
    message = dataclasses.replace(raw(stored.reshape(5, -1), encoding, padding=padding), width=6)
    labels = decode_labels(message, HERE)
    assert labels.is_color
    assert labels.pixels.dtype == np.uint8
    assert labels.pixels.flags.c_contiguous
    np.testing.assert_array_equal(labels.pixels, colors()[..., :3])


def test_every_label_encoding_is_covered():
    assert set(LABEL_ENCODINGS) == (set(KINDS) | set(COLOR_ORDERS)) - {"32FC1", "8UC3", "8UC4"}


def test_an_aligned_image_is_not_copied():
    message = raw(pixels_of("u2", 4, 4), "16UC1")
    image, _ = decode_depth(message, HERE)
    assert np.shares_memory(image, np.frombuffer(message.data, np.uint8))


def test_unaligned_bytes_are_copied_to_aligned_ones():
    message = raw(pixels_of("f4", 4, 4), "32FC1")
    shifted = np.zeros(len(message.data) + 1, np.uint8)
    shifted[1:] = message.data
    image, _ = decode_depth(dataclasses.replace(message, data=shifted[1:].data), HERE)
    assert image.flags.aligned
    np.testing.assert_array_equal(image, pixels_of("f4", 4, 4))


def test_the_last_row_may_lack_its_padding():
    message = raw(pixels_of("u2", 3, 4), "16UC1", padding=6)
    short = dataclasses.replace(message, data=message.data[:-6])
    np.testing.assert_array_equal(decode_depth(short, HERE)[0], pixels_of("u2", 3, 4))
    shorter = dataclasses.replace(message, data=message.data[:-7])
    with pytest.raises(DamagedMessageError, match=r"^a\.mcap: topic '/x' at 1\.000 s: the image holds 35 bytes, but 3"):
        decode_depth(shorter, HERE)


@pytest.mark.parametrize("unit", [None, 0.01])
@pytest.mark.parametrize("encoding", ["rgb8", "yuv422", "16SC1", "32SC1", "bayer_rggb8", "", "64FC1"])
def test_other_encodings_hold_no_depth_with_any_unit(encoding, unit):
    message = dataclasses.replace(raw(pixels_of("u1", 3, 24), "mono8"), encoding=encoding, width=2)
    with pytest.raises(
        InputError, match=f"'{encoding}' holds no depth; 16UC1, mono16, 32FC1, PNG, TIFF and compressedDepth"
    ):
        decode_depth(message, HERE, unit)


@pytest.mark.parametrize("encoding", ["yuv422", "32FC1", "", "64FC1"])
def test_other_encodings_hold_no_labels(encoding):
    message = dataclasses.replace(raw(pixels_of("u1", 3, 24), "mono8"), encoding=encoding, width=2)
    with pytest.raises(InputError, match=f"'{encoding}' holds no labels; mono8, 8UC1, mono16"):
        decode_labels(message, HERE)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_eight_bits_hold_depth_with_a_given_unit(encoding):
    with pytest.raises(InputError, match="8 bits with depth_unit"):
        decode_depth(raw(pixels_of("u1", 3, 4), encoding), HERE)
    image, unit = decode_depth(raw(pixels_of("u1", 3, 4), encoding), HERE, 0.05)
    assert (image.dtype, unit) == (np.uint8, 0.05)
    np.testing.assert_array_equal(image, pixels_of("u1", 3, 4))


def test_a_given_unit_replaces_the_encodings():
    assert decode_depth(raw(pixels_of("u2", 3, 4), "16UC1"), HERE, 0.0002)[1] == 0.0002
    assert decode_depth(encoded(png(pixels_of("u2", 3, 4))), HERE, 0.0002)[1] == 0.0002


@pytest.mark.parametrize(
    ("field", "value"),
    [("height", 0), ("width", 0), ("step", 7), ("height", 1000), ("width", 2**32 - 1), ("step", 2**32 - 1)],
)
@pytest.mark.parametrize("read", [decode_depth, decode_labels, decode_confidences])
def test_impossible_sizes_are_damage(read, field, value):
    message = dataclasses.replace(raw(pixels_of("u2", 3, 4), "16UC1"), **{field: value})
    with pytest.raises(DamagedMessageError):
        read(message, HERE)


# --- encoded images --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "unit"), [("u1", None), ("u2", 0.001)])
def test_png_of_one_channel(kind, unit):
    pixels = pixels_of(kind, 7, 9)
    message = encoded(png(pixels))
    assert encoding_and_size(message, HERE) == ({"u1": "8UC1", "u2": "16UC1"}[kind], (9, 7))
    labels = decode_labels(message, HERE)
    assert labels.pixels.dtype == np.dtype(kind)
    assert (labels.is_color, labels.is_lossy) == (False, False)
    np.testing.assert_array_equal(labels.pixels, pixels)
    if unit is None:
        with pytest.raises(InputError, match="a png image of uint8 holds no depth"):
            decode_depth(message, HERE)
    depth, found_unit = decode_depth(message, HERE, 0.5 if unit is None else None)
    assert found_unit == (unit or 0.5)
    np.testing.assert_array_equal(depth, pixels)


@pytest.mark.parametrize("channels", [3, 4])
def test_png_colours_are_red_green_blue(channels):
    message = encoded(png(np.ascontiguousarray(colors()[..., :channels])))
    assert encoding_and_size(message, HERE) == ("rgb8", (6, 5))
    labels = decode_labels(message, HERE)
    assert (labels.is_color, labels.is_lossy) == (True, False)
    np.testing.assert_array_equal(labels.pixels, colors()[..., :3])
    for read, problem in ((decode_depth, "holds no depth"), (decode_confidences, "holds no confidences")):
        with pytest.raises(InputError, match=problem):
            read(message, HERE)


@pytest.mark.parametrize("bits", [2, 4, 8])
def test_a_palette_gives_its_indices(bits):
    indices = (np.arange(63) % (1 << min(bits, 5))).astype(np.uint8).reshape(7, 9)
    image = PIL.Image.fromarray(indices)
    image.putpalette(np.random.default_rng(1).integers(0, 255, 3 << bits).tolist())
    message = encoded(saved(image, "PNG", bits=bits))
    assert encoding_and_size(message, HERE) == ("palette", (9, 7))
    labels = decode_labels(message, HERE)
    assert not labels.is_color
    np.testing.assert_array_equal(labels.pixels, indices)


def test_jpeg_is_lossy_and_keeps_the_order_of_its_channels():
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 250
    message = encoded(saved(PIL.Image.fromarray(red), "JPEG", quality=95), "jpeg")
    assert encoding_and_size(message, HERE) == ("jpeg rgb8", (16, 16))
    labels = decode_labels(message, HERE)
    assert (labels.is_color, labels.is_lossy) == (True, True)
    np.testing.assert_allclose(labels.pixels, red, atol=8)
    with pytest.raises(InputError, match="a jpeg image of uint8 holds no depth"):
        decode_depth(message, HERE)


def test_a_gray_jpeg_is_depth_only_where_a_unit_is_given():
    message = encoded(saved(PIL.Image.fromarray(np.full((16, 16), 77, np.uint8)), "JPEG"), "jpeg")
    with pytest.raises(InputError, match="holds no depth"):
        decode_depth(message, HERE)
    depth, unit = decode_depth(message, HERE, 0.1)
    assert unit == 0.1
    np.testing.assert_allclose(depth, 77, atol=2)


def test_colours_of_16_bits_are_no_labels():
    data = cv2.imencode(".png", colors().astype(np.uint16)[..., :3] * 257)[1].tobytes()
    with pytest.raises(InputError, match="'png of uint16' holds no labels"):
        decode_labels(encoded(data), HERE)


def compressed_depth(png_bytes: bytes, a: float = 0.0, b: float = 0.0) -> bytes:
    """Bytes of compressed_depth_image_transport: format number, two parameters, a PNG."""
    return struct.pack("<iff", 0, a, b) + png_bytes


@given(st.integers(1, 7), st.integers(1, 9))
def test_compressed_depth_of_16_bits_is_a_png_after_12_bytes(height, width):
    pixels = pixels_of("u2", height, width)
    message = encoded(compressed_depth(png(pixels)), "16UC1; compressedDepth png")
    assert encoding_and_size(message, HERE) == ("16UC1", (width, height))
    depth, unit = decode_depth(message, HERE)
    assert (depth.dtype, unit) == (np.uint16, 0.001)
    np.testing.assert_array_equal(depth, pixels)


@pytest.mark.parametrize("form", ["32FC1; compressedDepth", "32FC1; compressedDepth png"])
@pytest.mark.parametrize("quantisation", [50.0, 100.0])
def test_compressed_depth_of_floats_is_quantised_inverse_depth(form, quantisation):
    """Encoder of the transport: A = q (q + 1), B = 1 - A / max, value = A / depth + B."""
    depth_max = 10.0
    depth = np.linspace(0.6, 9.9, 63, dtype=np.float32).reshape(7, 9)
    a = quantisation * (quantisation + 1.0)
    b = 1.0 - a / depth_max
    values = np.round(a / depth.astype(np.float64) + b).astype(np.uint16)
    values[2, 3] = 0
    message = encoded(compressed_depth(png(values), a, b), form)
    assert encoding_and_size(message, HERE) == ("32FC1", (9, 7))
    found, unit = decode_depth(message, HERE)
    assert (found.dtype, unit) == (np.float32, 1.0)
    assert np.isnan(found[2, 3])
    # Half a step of the value is depth^2 / (2 A) in depth, plus the rounding of float32.
    error = np.abs(found - depth)
    error[2, 3] = 0.0
    assert (error <= depth.astype(np.float64) ** 2 / (2 * a) * 1.01 + 1e-5).all()
    assert error.max() > 0.0


@pytest.mark.parametrize("parameters", [(np.nan, 0.0), (1e38, 1.0), (0.0, np.inf), (1.0, 1.0)])
def test_odd_parameters_of_compressed_depth_give_odd_depth_without_warnings(parameters):
    message = encoded(compressed_depth(png(pixels_of("u2", 3, 4)), *parameters), "32FC1; compressedDepth png")
    assert decode_depth(message, HERE)[0].shape == (3, 4)


def test_empty_or_unsupported_compressed_depth():
    with pytest.raises(DamagedMessageError, match="the compressed depth image is empty"):
        decode_depth(encoded(b"\0" * 12, "16UC1; compressedDepth png"), HERE)
    with pytest.raises(DamagedMessageError, match="image cannot be decoded"):
        decode_depth(encoded(png(pixels_of("u2", 3, 4)), "16UC1; compressedDepth png"), HERE)
    with pytest.raises(InputError, match="holds no depth"):
        decode_depth(encoded(compressed_depth(png(colors())), "16UC1; compressedDepth png"), HERE)


@pytest.mark.parametrize("size", [(1 << 13, (1 << 13) + 1), (10_000, 10_000), (1 << 30, 1 << 20), (2**31 - 1, 1)])
def test_too_large_images_are_refused_before_they_are_decoded(size):
    message = encoded(png_head(*size))
    assert encoding_and_size(message, HERE) == ("16UC1", size)
    for read in (decode_depth, decode_labels, decode_confidences):
        with pytest.raises(InputError, match=f"an image of {size[0]}x{size[1]} pixels is too large to decode"):
            read(message, HERE)


@pytest.mark.parametrize("size", [(8000, 8000), (60_000, 1000)])
def test_memory_is_allocated_only_for_pixels_that_the_bytes_can_hold(monkeypatch, size):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("made room"))
    for read in (decode_depth, decode_labels, decode_confidences):
        with pytest.raises(DamagedMessageError, match="cannot be decoded"):
            read(encoded(png_head(*size)), HERE)


def test_images_of_one_value_are_decoded_from_small_files():
    for pixels in (np.zeros((2000, 3000), np.uint16), np.zeros((2000, 3000), np.uint8)):
        np.testing.assert_array_equal(decode_labels(encoded(png(pixels)), HERE).pixels, pixels)
    single_bits = saved(PIL.Image.fromarray(np.zeros((4000, 6000), bool)), "PNG")
    assert decode_labels(encoded(single_bits), HERE).pixels.shape == (4000, 6000)
    for quality in (1, 95):
        jpeg = saved(PIL.Image.fromarray(np.zeros((2000, 3000), np.uint8)), "JPEG", quality=quality, progressive=True)
        assert decode_depth(encoded(jpeg, "jpeg"), HERE, 0.1)[0].shape == (2000, 3000)
        with pytest.raises(InputError, match="lossy compression changes label ids"):
            decode_labels(encoded(jpeg, "jpeg"), HERE)


FILES = {
    "16 bits": png(pixels_of("u2", 20, 30)), "colours": png(colors(20, 30)),
    "jpeg": saved(PIL.Image.fromarray(colors(20, 30)[..., :3]), "JPEG"),
    "webp": saved(PIL.Image.fromarray(colors(20, 30)), "WEBP", lossless=True),
}  # fmt: skip
_palette = PIL.Image.fromarray(pixels_of("u1", 20, 30))
_palette.putpalette(list(range(256)) * 3)
FILES["palette"] = saved(_palette, "PNG")


@pytest.mark.parametrize("name", ["16 bits", "colours", "palette"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9])
def test_a_cut_png_is_damage(name, share):
    data = FILES[name]
    with pytest.raises(DamagedMessageError, match=r"^a\.mcap: topic '/x' at 1\.000 s: the png image cannot be decoded"):
        decode_labels(encoded(data[: int(len(data) * share)]), HERE)


@given(st.sampled_from(sorted(FILES)), st.integers(0, 10**6), st.binary(min_size=1, max_size=10), st.booleans())
@examples(300)
def test_damaged_files_raise_nothing_but_input_errors(name, position, noise, is_depth):
    data = bytearray(FILES[name])
    position %= len(data)
    data[position : position + len(noise)] = noise
    data = compressed_depth(bytes(data), 1.0, 1.0) if is_depth else bytes(data)
    message = encoded(data, "32FC1; compressedDepth png" if is_depth else "png")
    for read in (encoding_and_size, decode_depth, decode_labels, decode_confidences):
        try:
            read(message, HERE)
        except InputError:
            continue


@given(st.binary(max_size=200), st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"RIFF"]))
@examples(300)
def test_garbage_is_damage(garbage, magic):
    for form in ("png", "16UC1; compressedDepth png", ""):
        with pytest.raises(DamagedMessageError, match=r"^a\.mcap: topic '/x' at 1\.000 s: the .*image "):
            decode_labels(encoded(magic + garbage, form), HERE)


# --- confidences -----------------------------------------------------------------------------------------------------


def test_confidences_are_255ths_of_the_types_largest_value():
    bytes_ = np.array([[0, 1, 255]], "u1")
    np.testing.assert_array_equal(decode_confidences(raw(bytes_, "mono8"), HERE), bytes_)
    words = np.array([[0, 257, 129, 65535]], "u2")
    np.testing.assert_array_equal(decode_confidences(raw(words, "16UC1", big_endian=True), HERE), [[0, 1, 1, 255]])
    np.testing.assert_array_equal(decode_confidences(encoded(png(words)), HERE), [[0, 1, 1, 255]])
    floats = np.array([[0.0, 0.5, 1.0, 1.5, -1.0, np.nan, np.inf, -np.inf]], "f4")
    found = decode_confidences(raw(floats, "32FC1"), HERE)
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, [[0, 128, 255, 255, 0, 0, 255, 0]])


@given(st.sampled_from(["u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"]), st.sampled_from("<>"), st.integers(0, 100))
def test_confidences_of_any_kind(kind, order, percent):
    largest = 1.0 if kind[0] == "f" else np.iinfo(kind).max
    value = np.array([largest * percent / 100]).astype(order + kind)
    assert abs(int(confidences(value)[0]) - 2.55 * percent) <= 0.5 + 255 / largest * (kind[0] != "f") + 1e-4


@pytest.mark.parametrize("encoding", ["rgb8", "16SC1", "yuv422"])
def test_other_images_hold_no_confidences(encoding):
    message = dataclasses.replace(raw(pixels_of("u1", 3, 24), "mono8"), encoding=encoding, width=2)
    with pytest.raises(InputError, match="holds no confidences; one channel of 8UC1, 16UC1 or 32FC1"):
        decode_confidences(message, HERE)


def test_raw_images_have_the_limit_of_encoded_ones():
    image = Image(5, "camera", 1 << 13, (1 << 13) + 1, "mono8", False, (1 << 13) + 1, bytes((1 << 26) + (1 << 13)))
    with pytest.raises(InputError, match="an image of 8193x8192 pixels is too large"):
        decode_labels(image, HERE)
