"""Image messages, raw or encoded, to arrays of depth, labels and confidences."""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import PIL.Image
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.WebPImagePlugin import WebPImageFile

from octoreplay.errors import InputError
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import CompressedImage, Image
from octoreplay.records import UInt8Array

DEPTH_ENCODINGS = {"16UC1": 0.001, "mono16": 0.001, "32FC1": 1.0}
"""Depth encodings and metres per unit (REP 118)."""

COLOR_ENCODINGS = ("rgb8", "bgr8", "rgba8", "bgra8")
"""Encodings of label images whose colours mean labels."""

LABEL_ENCODINGS = ("mono8", "8UC1", "mono16", "16UC1", "16SC1", "32SC1", *COLOR_ENCODINGS)
"""Encodings of label images: ids, or colours."""

MAX_PIXELS = 1 << 26
"""Images of more pixels are refused before they are decoded, and clouds of more points."""

# What a byte of a PNG or JPEG can hold at most: deflate makes 1032 bytes of one, each of eight pixels of a bit; a JPEG
# has a bit at least for every block of 64 pixels.
_MAX_PIXELS_PER_BYTE = 8 * 1032

_ELEMENTS = {
    "mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "16SC1": "i2", "32SC1": "i4", "32FC1": "f4",
    "rgb8": "3u1", "bgr8": "3u1", "rgba8": "4u1", "bgra8": "4u1", "8UC3": "3u1", "8UC4": "4u1",
}  # fmt: skip
# Pillow's modes of pixels.
_MODES = {"P": "palette", "L": "8UC1", "1": "8UC1", "F": "32FC1"}
# What Pillow's readers raise for bytes that are damaged.
_UNREADABLE = (
    OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, ArithmeticError, LookupError, TypeError,
    AttributeError, RuntimeError, MemoryError,
)  # fmt: skip
# Their classes read a head without PIL.Image.open's own limit of size, which warns before it refuses.
_FILES = (
    (b"\x89PNG\r\n\x1a\n", PngImageFile), (b"\xff\xd8\xff", JpegImageFile), (b"RIFF", WebPImageFile),
)  # fmt: skip
# compressed_depth_image_transport: its format's number and two parameters of the quantisation, before a PNG.
_DEPTH_HEADER = struct.Struct("<iff")


@dataclass(frozen=True, eq=False)
class LabelImage:
    """Raw labels (H, W) of an integer type, or colours (H, W, 3) uint8 red, green, blue; lossy ones are not exact."""

    pixels: npt.NDArray[Any]
    is_lossy: bool = False

    @property
    def is_color(self) -> bool:
        """True where the labels are colours."""
        return self.pixels.ndim == 3


def encoding_and_size(image: Image | CompressedImage, where: str) -> tuple[str, tuple[int, int]]:
    """An image's encoding and size (width, height), of an encoded image from its head alone.

    PNGs have the encodings of raw images (``16UC1``, ``8UC1``, ``rgb8``), others their format in front of it
    (``jpeg rgb8``). Raises DamagedMessageError where there is no such head.
    """
    if isinstance(image, Image):
        return image.encoding, (image.width, image.height)
    data = bytes(image.data)
    is_depth = "compresseddepth" in image.format.lower()
    head, size = _head(image, data[_DEPTH_HEADER.size :] if is_depth else data, where)
    if is_depth:
        return image.format.split(";")[0], size
    return head.removeprefix("png "), size


def decode_depth(
    image: Image | CompressedImage, where: str, depth_unit: float | None = None
) -> tuple[npt.NDArray[Any], float]:
    """The depth image (H, W), uint8, uint16 or float32, and its unit: metres along z = value x unit.

    ``depth_unit`` takes the place of the encoding's unit (REP 118), and lets 8 bits and lossy images hold depth.
    ``where`` begins the errors. The array is C-contiguous, aligned and in native byte order; it is a view of the
    message where its bytes allow that.
    Raises InputError for an image that holds no depth, DamagedMessageError where its bytes are not what it announces.
    """
    if isinstance(image, CompressedImage):
        pixels, is_lossy = _decode_depth_file(image, where)
        unit = {"u2": 0.001, "f4": 1.0}.get(pixels.dtype.str[1:]) if not is_lossy else None
        found = f"a {image.format or 'compressed'} image of {pixels.dtype}"
    else:
        unit, found = DEPTH_ENCODINGS.get(image.encoding), f"image encoding '{image.encoding}'"
        is_used = unit is not None or (depth_unit is not None and image.encoding in ("mono8", "8UC1"))
        pixels = _pixels(image, where) if is_used else np.empty((0, 0, 0))
    holds_depth = pixels.ndim == 2 and pixels.dtype.str[1:] in ("u1", "u2", "f4")
    if not holds_depth or (unit is None and depth_unit is None):
        raise InputError(
            f"{where}: {found} holds no depth; {', '.join(DEPTH_ENCODINGS)}, PNG and compressedDepth can be read, "
            f"and one channel of 8 bits where depth_unit is given"
        )
    return pixels, float(depth_unit if depth_unit is not None else unit or 0.0)


def decode_labels(image: Image | CompressedImage, where: str) -> LabelImage:
    """The raw labels of a label image, or the colours that mean labels.

    As ``decode_depth`` otherwise. Raises InputError for another encoding, DamagedMessageError for damaged bytes.
    """
    if isinstance(image, CompressedImage):
        pixels, is_lossy = _decode_file(image, bytes(image.data), where)
        encoding = f"{image.format} of {pixels.dtype}"
    else:
        encoding, is_lossy = image.encoding, False
        pixels = _pixels(image, where) if encoding in (*LABEL_ENCODINGS, "8UC3", "8UC4") else np.empty(0)
        # Channels without a name are in OpenCV's order, as Foxglove says and cv_bridge writes them.
        if encoding in ("bgr8", "bgra8", "8UC3", "8UC4"):
            pixels = pixels[..., [2, 1, 0]]
    if pixels.ndim < 2 or pixels.dtype.kind == "f" or (pixels.ndim == 3 and pixels.dtype != np.uint8):
        raise InputError(
            f"{where}: image encoding '{encoding}' holds no labels; {', '.join(LABEL_ENCODINGS)}, PNG and JPEG can be "
            f"read"
        )
    if is_lossy and pixels.ndim == 2:
        raise InputError(f"{where}: a lossy image of ids holds no labels, as it changes them; record PNG, or colours")
    return LabelImage(pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., :3]), is_lossy)


def decode_confidences(image: Image | CompressedImage, where: str) -> UInt8Array:
    """How sure each label is, (H, W) uint8 in 255ths, from 8 or 16 bits (their largest value: sure) or float (1: sure).

    Raises InputError for other images, DamagedMessageError for damaged bytes.
    """
    if isinstance(image, CompressedImage):
        pixels, _ = _decode_file(image, bytes(image.data), where)
    else:
        pixels = _pixels(image, where) if image.encoding in _ELEMENTS else np.empty(0)
    if pixels.ndim != 2 or pixels.dtype.str[1:] not in ("u1", "u2", "f4"):
        raise InputError(f"{where}: the image holds no confidences; one channel of 8UC1, 16UC1 or 32FC1 can be read")
    return confidences(pixels)


def confidences(values: npt.NDArray[Any]) -> UInt8Array:
    """Confidences in 255ths, uint8, of integers (their type's largest value: sure) or floats (1: sure, NaN: not)."""
    if values.dtype == np.uint8:
        return values
    scale = 1.0 if values.dtype.kind == "f" else float(np.iinfo(values.dtype).max)
    with np.errstate(invalid="ignore"):
        shares = np.clip(np.nan_to_num(values.astype(np.float64) / scale), 0.0, 1.0)
    return np.rint(255.0 * shares).astype(np.uint8)


def _pixels(image: Image, where: str) -> npt.NDArray[Any]:
    """Pixels (H, W) or (H, W, channels), without the rows' padding, native and aligned."""
    dtype = np.dtype((">" if image.is_big_endian else "<") + _ELEMENTS[image.encoding].lstrip("34"))
    channels = int(_ELEMENTS[image.encoding][0]) if _ELEMENTS[image.encoding][0].isdigit() else 1
    height, width, step = image.height, image.width, image.step
    row_bytes = width * channels * dtype.itemsize
    if height < 1 or width < 1 or step < row_bytes:
        raise DamagedMessageError(
            f"{where}: an image of {width}x{height} {image.encoding} cannot have rows of {step} bytes"
        )
    # The last row may come without its padding.
    if len(image.data) < step * (height - 1) + row_bytes:
        raise DamagedMessageError(
            f"{where}: the image holds {len(image.data)} bytes, but {height} rows of {step} bytes are announced"
        )
    if width * height > MAX_PIXELS:
        raise InputError(f"{where}: an image of {width}x{height} pixels is too large")
    strides = (step, channels * dtype.itemsize, dtype.itemsize)
    pixels = np.ndarray((height, width, channels), dtype, buffer=image.data, strides=strides)
    native = (pixels[..., 0] if channels == 1 else pixels).astype(dtype.newbyteorder("="), copy=False)
    return np.require(native, requirements=["C", "A"])


def _decode_depth_file(image: CompressedImage, where: str) -> tuple[npt.NDArray[Any], bool]:
    """The depth of an encoded image, with the header of compressedDepth where its format says so, and whether lossy.

    Quantised inverse depth becomes metres: depth = A / (value - B), 0 means none (compressed_depth_image_transport).
    """
    if "compresseddepth" not in image.format.lower():
        return _decode_file(image, bytes(image.data), where)
    if "rvl" in image.format.lower():
        raise InputError(f"{where}: depth compressed with RVL is not supported; record it with format: png")
    data = bytes(image.data)
    if len(data) <= _DEPTH_HEADER.size:
        raise DamagedMessageError(f"{where}: the compressed depth image is empty")
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    pixels, _ = _decode_file(image, data[_DEPTH_HEADER.size :], where)
    if not image.format.startswith("32FC1"):
        return pixels, False
    values = pixels.astype(np.float32)
    with np.errstate(all="ignore"):
        depth = np.float32(a) / (values - np.float32(b))
    return np.where(values > 0, depth, np.float32(np.nan)), False


def _decode_file(image: CompressedImage, data: bytes, where: str) -> tuple[npt.NDArray[Any], bool]:
    """The pixels of a PNG, JPEG or the like, colours in the order red, green, blue; and whether they are lossy.

    A PNG with a palette gives its indices, which is how label images use it.
    """
    head, (width, height) = _head(image, data, where)
    if width * height > MAX_PIXELS:
        raise InputError(f"{where}: an image of {width}x{height} pixels is too large to decode")
    # Room for the pixels is made before they are found to be missing.
    if width * height > _MAX_PIXELS_PER_BYTE * len(data) and head.startswith(("png", "jpeg")):
        raise _undecodable(image, where)
    try:
        if head == "png palette":
            return np.array(PIL.Image.open(io.BytesIO(data))), False
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except (*_UNREADABLE, cv2.error) as error:
        raise _undecodable(image, where) from error
    if pixels is None:
        raise _undecodable(image, where)
    return (pixels if pixels.ndim == 2 else pixels[..., [2, 1, 0]]), head.startswith("jpeg")


def _head(image: CompressedImage, data: bytes, where: str) -> tuple[str, tuple[int, int]]:
    """Format and pixels of an encoded image, such as 'png 16UC1' or 'jpeg rgb8', and its size (width, height)."""
    reader = next((reader for magic, reader in _FILES if data.startswith(magic)), None)
    if reader is None:
        raise _undecodable(image, where)
    try:
        with reader(io.BytesIO(data)) as header:
            pixels = _MODES.get(header.mode, "16UC1" if header.mode.startswith("I") else "rgb8")
            return f"{str(header.format).lower()} {pixels}", header.size
    except _UNREADABLE as error:
        raise _undecodable(image, where) from error


def _undecodable(image: CompressedImage, where: str) -> DamagedMessageError:
    return DamagedMessageError(f"{where}: the {image.format or 'compressed'} image cannot be decoded")
