"""Decoding of image messages, raw or compressed, into arrays of depth, labels and confidences."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import IO, Any

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
from octoreplay.io.sensors.rvl import decode_rvl
from octoreplay.io.sensors.tiff import MAGICS, read_tiff_header
from octoreplay.records import UInt8Array

DEPTH_ENCODINGS = {"16UC1": 0.001, "mono16": 0.001, "32FC1": 1.0}
"""Depth encodings and metres per unit (REP 118)."""

COLOR_ENCODINGS = ("rgb8", "bgr8", "rgba8", "bgra8")
"""Encodings of label images with colours in place of ids."""

LABEL_ENCODINGS = ("mono8", "8UC1", "mono16", "16UC1", "16SC1", "32SC1", *COLOR_ENCODINGS)
"""Encodings of label images: ids or colours."""

_BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB, "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB, "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
}  # fmt: skip
_YUV = {
    "yuv422": cv2.COLOR_YUV2RGB_UYVY, "uyvy": cv2.COLOR_YUV2RGB_UYVY, "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
}  # fmt: skip

COLOR_IMAGE_ENCODINGS = (
    *COLOR_ENCODINGS, "8UC3", "8UC4", "mono8", "8UC1", *_BAYER, *_YUV, "jpeg rgb8", "jpeg 8UC1", "webp rgb8",
)  # fmt: skip
"""Encodings of colour and grey images that ``decode_color`` can read, as ``encoding_and_size`` gives them."""

MAX_PIXELS = 1 << 26
"""Largest number of pixels of an image and of points of a cloud; larger ones are refused before decoding."""

SMALL_IMAGE = 1 << 25
"""Number of pixels that a compressed image may have however small it is; an image without depth takes a few kB."""
MAX_PIXELS_PER_BYTE = 64
"""Largest number of pixels for each byte of a compressed image above SMALL_IMAGE."""

_ELEMENTS = {
    "mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "16SC1": "i2", "32SC1": "i4", "32FC1": "f4",
    "rgb8": "3u1", "bgr8": "3u1", "rgba8": "4u1", "bgra8": "4u1", "8UC3": "3u1", "8UC4": "4u1",
    **dict.fromkeys(_BAYER, "u1"), **dict.fromkeys(_YUV, "2u1"),
}  # fmt: skip
# Encodings of Pillow's pixel modes.
_MODES = {"P": "palette", "L": "8UC1", "1": "8UC1", "F": "32FC1"}
UNREADABLE = (
    OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, ArithmeticError, LookupError, TypeError,
    AttributeError, RuntimeError, MemoryError,
)  # fmt: skip
"""Exceptions that Pillow's readers raise for damaged bytes."""
# These classes read headers without the size limit of PIL.Image.open, which warns before it raises.
_FILES: tuple[tuple[bytes, Callable[[IO[bytes]], Any]], ...] = (
    (b"\x89PNG\r\n\x1a\n", PngImageFile), (b"\xff\xd8\xff", JpegImageFile), (b"RIFF", WebPImageFile),
    *((magic, read_tiff_header) for magic in MAGICS),
)  # fmt: skip
# compressed_depth_image_transport: format number and two quantisation parameters, followed by a PNG, or by the numbers
# of columns and rows and an RVL stream.
_DEPTH_HEADER, _RVL_SIZE = struct.Struct("<iff"), struct.Struct("<ii")


@dataclass(frozen=True, eq=False)
class LabelImage:
    """Raw labels (H, W) of an integer type, or colours (H, W, 3) uint8 RGB; ``is_lossy`` where they are not exact."""

    pixels: npt.NDArray[Any]
    is_lossy: bool = False

    @property
    def is_color(self) -> bool:
        """True where the pixels are colours."""
        return self.pixels.ndim == 3


def encoding_and_size(image: Image | CompressedImage, where: str) -> tuple[str, tuple[int, int]]:
    """Return an image's encoding and size (width, height); of a compressed image only the header is read.

    PNG and TIFF have the encodings of raw images (``16UC1``, ``8UC1``, ``rgb8``), other formats precede it
    (``jpeg rgb8``).
    Raises DamagedMessageError where the header cannot be read.
    """
    if isinstance(image, Image):
        return image.encoding, (image.width, image.height)
    data = bytes(image.data)
    if not _is_compressed_depth(image):
        head, size = _read_header(image, data, where)
        return head.removeprefix("png ").removeprefix("tiff "), size
    content = data[_DEPTH_HEADER.size :]
    size = _rvl_size(image, content, where) if _is_rvl(image) else _read_header(image, content, where)[1]
    return image.format.split(";")[0], size


def decode_depth(
    image: Image | CompressedImage, where: str, depth_unit: float | None = None
) -> tuple[npt.NDArray[Any], float]:
    """Return the depth image (H, W), uint8, uint16 or float32, and its unit: metres along z = value x unit.

    ``depth_unit`` replaces the encoding's unit (REP 118); with it 8-bit and lossy images are accepted too. ``where``
    begins the errors. The array is C-contiguous, aligned and in native byte order; it is a view of the message where
    possible. Raises InputError for an image without depth, DamagedMessageError where its bytes do not fit its size.
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
            f"{where}: {found} holds no depth; {', '.join(DEPTH_ENCODINGS)}, PNG, TIFF and compressedDepth can be "
            f"read, "
            f"and one channel of 8 bits with depth_unit"
        )
    return pixels, float(depth_unit if depth_unit is not None else unit or 0.0)


def decode_labels(image: Image | CompressedImage, where: str) -> LabelImage:
    """Return the raw labels or colours of a label image.

    The array is as that of ``decode_depth``. Raises InputError for another encoding, DamagedMessageError for damaged
    bytes.
    """
    if isinstance(image, CompressedImage):
        pixels, is_lossy = _decode_file(image, bytes(image.data), where)
        encoding = f"{image.format} of {pixels.dtype}"
    else:
        encoding, is_lossy = image.encoding, False
        pixels = _pixels(image, where) if encoding in (*LABEL_ENCODINGS, "8UC3", "8UC4") else np.empty(0)
        # 8UC3 and 8UC4 have OpenCV's channel order, as in Foxglove's schema and cv_bridge.
        if encoding in ("bgr8", "bgra8", "8UC3", "8UC4"):
            pixels = pixels[..., [2, 1, 0]]
    if pixels.ndim < 2 or pixels.dtype.kind == "f" or (pixels.ndim == 3 and pixels.dtype != np.uint8):
        raise InputError(
            f"{where}: image encoding '{encoding}' holds no labels; {', '.join(LABEL_ENCODINGS)}, PNG and JPEG can be "
            f"read"
        )
    if is_lossy and pixels.ndim == 2:
        raise InputError(f"{where}: lossy compression changes label ids; record PNG, or colours")
    return LabelImage(pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., :3]), is_lossy)


def decode_color(image: Image | CompressedImage, where: str) -> UInt8Array:
    """Return a colour image (H, W, 3) uint8 red, green, blue; a grey image has three equal channels.

    8UC3 and 8UC4 have OpenCV's channel order. Raises InputError for another encoding, DamagedMessageError for damaged
    bytes.
    """
    if isinstance(image, CompressedImage):
        pixels, _ = _decode_file(image, bytes(image.data), where)
        encoding = f"{image.format} of {pixels.dtype}"
    else:
        encoding = image.encoding
        pixels = _pixels(image, where) if encoding in COLOR_IMAGE_ENCODINGS else np.empty(0, dtype=np.uint8)
        if encoding in ("bgr8", "bgra8", "8UC3", "8UC4"):
            pixels = pixels[..., [2, 1, 0]]
        elif encoding in _BAYER or encoding in _YUV:
            pixels = _demosaiced(pixels, encoding, where)
    if pixels.ndim < 2 or pixels.dtype != np.uint8:
        raise InputError(
            f"{where}: image encoding '{encoding}' holds no colours of 8 bits; {', '.join(COLOR_ENCODINGS)}, mono8, "
            "8-bit Bayer patterns, YUV 4:2:2, PNG, JPEG and WebP can be read"
        )
    return np.ascontiguousarray(np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels[..., :3])


def _demosaiced(pixels: npt.NDArray[Any], encoding: str, where: str) -> npt.NDArray[Any]:
    """Colours (H, W, 3) of a Bayer pattern (H, W) or of YUV 4:2:2 (H, W, 2)."""
    try:
        return np.asarray(cv2.cvtColor(pixels, (_BAYER | _YUV)[encoding]))
    except cv2.error as error:
        size = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise DamagedMessageError(f"{where}: an image of {size} {encoding} cannot be decoded") from error


def decode_confidences(image: Image | CompressedImage, where: str) -> UInt8Array:
    """Return the label confidences (H, W) uint8 in 255ths of an image of 8 or 16 bits, or of floats from 0 to 1.

    The largest integer is a confidence of 1. Raises InputError for other images, DamagedMessageError for damaged bytes.
    """
    if isinstance(image, CompressedImage):
        pixels, _ = _decode_file(image, bytes(image.data), where)
    else:
        is_plain = image.encoding in _ELEMENTS and image.encoding not in _BAYER
        pixels = _pixels(image, where) if is_plain else np.empty(0)
    if pixels.ndim != 2 or pixels.dtype.str[1:] not in ("u1", "u2", "f4"):
        raise InputError(f"{where}: the image holds no confidences; one channel of 8UC1, 16UC1 or 32FC1 can be read")
    return confidences(pixels)


def confidences(values: npt.NDArray[Any]) -> UInt8Array:
    """Return confidences in 255ths, uint8, of integers (the type's largest value is 1) or floats (NaN is 0)."""
    if values.dtype == np.uint8:
        return values
    scale = 1.0 if values.dtype.kind == "f" else float(np.iinfo(values.dtype).max)
    with np.errstate(invalid="ignore"):
        shares = np.clip(np.nan_to_num(values.astype(np.float64) / scale), 0.0, 1.0)
    return np.rint(255.0 * shares).astype(np.uint8)


def most_pixels(num_bytes: int) -> int:
    """Return the largest number of pixels of a compressed image of ``num_bytes``."""
    return min(MAX_PIXELS, max(SMALL_IMAGE, MAX_PIXELS_PER_BYTE * num_bytes))


def _pixels(image: Image, where: str) -> npt.NDArray[Any]:
    """Pixels (H, W) or (H, W, channels) without row padding, in native byte order, aligned."""
    dtype = np.dtype((">" if image.is_big_endian else "<") + _ELEMENTS[image.encoding].lstrip("34"))
    channels = int(_ELEMENTS[image.encoding][0]) if _ELEMENTS[image.encoding][0].isdigit() else 1
    height, width, step = image.height, image.width, image.step
    row_bytes = width * channels * dtype.itemsize
    if height < 1 or width < 1 or step < row_bytes:
        raise DamagedMessageError(
            f"{where}: an image of {width}x{height} {image.encoding} cannot have rows of {step} bytes"
        )
    # The last row may have no padding.
    if len(image.data) < step * (height - 1) + row_bytes:
        raise DamagedMessageError(
            f"{where}: the image holds {len(image.data)} bytes, but {height} rows of {step} bytes are expected"
        )
    if width * height > MAX_PIXELS:
        raise InputError(f"{where}: an image of {width}x{height} pixels is too large")
    strides = (step, channels * dtype.itemsize, dtype.itemsize)
    pixels = np.ndarray((height, width, channels), dtype, buffer=image.data, strides=strides)
    native = (pixels[..., 0] if channels == 1 else pixels).astype(dtype.newbyteorder("="), copy=False)
    return np.require(native, requirements=["C", "A"])


def _decode_depth_file(image: CompressedImage, where: str) -> tuple[npt.NDArray[Any], bool]:
    """The depth of a compressed image, and whether it is lossy.

    compressedDepth begins with a header; its quantised inverse depth is depth = A / (value - B) in metres, 0 where
    nothing was measured (compressed_depth_image_transport).
    """
    data = bytes(image.data)
    if not _is_compressed_depth(image):
        return _decode_file(image, data, where)
    if len(data) <= _DEPTH_HEADER.size:
        raise DamagedMessageError(f"{where}: the compressed depth image is empty")
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    content = data[_DEPTH_HEADER.size :]
    pixels = _decode_rvl(image, content, where) if _is_rvl(image) else _decode_file(image, content, where)[0]
    if not image.format.startswith("32FC1"):
        return pixels, False
    values = pixels.astype(np.float32)
    with np.errstate(all="ignore"):
        depth = np.float32(a) / (values - np.float32(b))
    return np.where(values > 0, depth, np.float32(np.nan)), False


def _is_compressed_depth(image: CompressedImage) -> bool:
    """True for an image of compressed_depth_image_transport."""
    return "compresseddepth" in image.format.lower()


def _is_rvl(image: CompressedImage) -> bool:
    """True for a compressedDepth image whose content is RVL."""
    return "rvl" in image.format.lower()


def _rvl_size(image: CompressedImage, content: bytes, where: str) -> tuple[int, int]:
    """Width and height of an RVL image. Raises DamagedMessageError where its bytes cannot hold them."""
    if len(content) < _RVL_SIZE.size:
        raise _undecodable(image, where)
    width, height = _RVL_SIZE.unpack_from(content)
    if min(width, height) < 1 or width * height > most_pixels(len(content)):
        raise _undecodable(image, where)
    return width, height


def _decode_rvl(image: CompressedImage, content: bytes, where: str) -> npt.NDArray[Any]:
    """The values of an RVL image (H, W) uint16."""
    width, height = _rvl_size(image, content, where)
    try:
        return decode_rvl(content[_RVL_SIZE.size :], width * height).reshape(height, width)
    except ValueError as error:
        raise _undecodable(image, where) from error


def _decode_file(image: CompressedImage, data: bytes, where: str) -> tuple[npt.NDArray[Any], bool]:
    """The pixels of a PNG, JPEG, WebP or TIFF file, colours as RGB, and whether they are lossy.

    A PNG with a palette gives the indices, which are the ids of a label image.
    """
    head, (width, height) = _read_header(image, data, where)
    if width * height > MAX_PIXELS:
        raise InputError(f"{where}: an image of {width}x{height} pixels is too large to decode")
    # The decoder allocates all pixels before it finds the file cut.
    if width * height > most_pixels(len(data)):
        raise _undecodable(image, where)
    try:
        if head == "png palette":
            return np.array(PIL.Image.open(io.BytesIO(data))), False
        with _quiet_opencv() if head.startswith("tiff") else nullcontext():
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except (*UNREADABLE, cv2.error) as error:
        raise _undecodable(image, where) from error
    if pixels is None or pixels.shape[:2] != (height, width):
        raise _undecodable(image, where)
    return (pixels if pixels.ndim == 2 else pixels[..., [2, 1, 0]]), head.startswith("jpeg")


@contextmanager
def _quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from writing libtiff's warnings about damaged files to the terminal."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _read_header(image: CompressedImage, data: bytes, where: str) -> tuple[str, tuple[int, int]]:
    """Format and encoding of a compressed image, such as 'png 16UC1' or 'jpeg rgb8', and its size (width, height)."""
    reader = next((reader for magic, reader in _FILES if data.startswith(magic)), None)
    if reader is None:
        raise _undecodable(image, where)
    try:
        with reader(io.BytesIO(data)) as header:
            pixels = _MODES.get(header.mode, "16UC1" if header.mode.startswith("I") else "rgb8")
            return f"{str(header.format).lower()} {pixels}", header.size
    except UNREADABLE as error:
        raise _undecodable(image, where) from error


def _undecodable(image: CompressedImage, where: str) -> DamagedMessageError:
    """The error for an image that cannot be decoded."""
    return DamagedMessageError(f"{where}: the {image.format or 'compressed'} image cannot be decoded")
