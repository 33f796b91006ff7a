"""Semantic segmentation network in an ONNX file: its input, its run on the CPU, and labels from its output.

Formats: https://onnx.ai/onnx/repo-docs/MetadataProps.html (keys Image.BitmapPixelFormat and Image.NominalPixelRange)
and https://onnxruntime.ai/docs/api/python/api_summary.html
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.sensors.labels import UNLABELLED
from octoreplay.records import ClassTable, Float32Array, Int32Array, UInt8Array

LAYOUTS = ("nchw", "nhwc")
CHANNELS = ("rgb", "bgr")
OUTPUT_KINDS = ("auto", "logits", "probabilities", "labels")
MAX_MODEL_BYTES = 1 << 32
"""Size from which a model file is refused [bytes]; ONNX files are at most 2 GiB without external data."""
MAX_INPUT_PIXELS = 1 << 24
MAX_OUTPUT_VALUES = 1 << 28
"""Largest number of values of an output that a model declares; larger ones are refused before the first run."""
MAX_CLASSES = 4096
MAX_LABEL = 65534
"""Largest raw label; 65535 is that of pixels without a label."""

_LONGEST_CAUSE = 300
_RANGES = {"nominalrange_0_255": (1.0, 0.0, 1.0), "normalized_0_1": (1 / 255, 0.0, 1.0),
           "normalized_1_1": (1 / 255, 0.5, 0.5)}  # fmt: skip
"""Scale, mean and standard deviation of each value of Image.NominalPixelRange."""
_INPUT_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
_SUM_TOLERANCE = 1e-3

T = TypeVar("T")


@dataclass(frozen=True)
class NetworkOptions:
    """Options that replace what the model's file says about its input and output; None leaves it to the file.

    A value of the input is (pixel x ``scale`` - ``mean``) / ``std`` for pixels 0 to 255. ``input_size`` is (width,
    height) in pixels. The raw label of output k is k + ``label_offset``. ``threads`` is 0 for one for each core.
    """

    input_size: tuple[int, int] | None = None
    mean: tuple[float, ...] | None = None
    std: tuple[float, ...] | None = None
    scale: float | None = None
    layout: str | None = None
    channels: str | None = None
    output_name: str | None = None
    output_kind: str = "auto"
    label_offset: int = 0
    threads: int = 0

    def __post_init__(self) -> None:
        if self.input_size is not None and not 0 < self.input_size[0] * self.input_size[1] <= MAX_INPUT_PIXELS:
            raise ConfigError(f"input_size: {self.input_size[0]}x{self.input_size[1]} has too few or too many pixels")
        if not 0 <= self.label_offset <= MAX_LABEL:
            raise ConfigError(f"label_offset: {self.label_offset} is not between 0 and {MAX_LABEL}")
        for name, values in (("mean", self.mean), ("std", self.std), ("scale", (self.scale or 1.0,))):
            if values is not None and not np.isfinite(values).all():
                raise ConfigError(f"{name}: expects finite numbers")
        if 0.0 in (self.std or ()) or self.scale == 0.0:
            raise ConfigError("std and scale: must not be 0")


@dataclass(frozen=True, eq=False)
class Labels:
    """Raw labels (H, W) int32 of an image, and their confidences (H, W) uint8 in 255ths; None where there are none."""

    raw: Int32Array
    confidences: UInt8Array | None


class Network:
    """Network of an ONNX file, with the class table that gives its labels a meaning.

    Raises ConfigError where onnxruntime is missing, an option does not fit the model, or a label of its output is not
    in the class table; InputError for a file that is no such network.
    """

    def __init__(self, path: Path, classes: ClassTable, options: NetworkOptions | None = None) -> None:
        self.path = path
        self._options = options or NetworkOptions()
        known = {raw for item in classes.classes for raw in item.raw_labels}
        self._known = known | set(classes.ignored_raw_labels) | set(UNLABELLED)
        self._session = _session(path, self._options.threads)
        self._set_input()
        self._set_output()

    def label(self, image: UInt8Array, where: str) -> Labels:
        """Return the labels of a colour image (H, W, 3) uint8 red, green, blue, of its size.

        ``where`` begins the errors. Raises InputError where the network fails or gives no finite values, ConfigError
        where a label is not in the class table.
        """
        size = self._size or (image.shape[1], image.shape[0])
        fed = {self._input: self._prepared(image, size)}
        (output,) = _guarded(
            lambda: self._session.run([self._output], fed),
            f"{where}: the network {self.path} cannot be run on an image of {size[0]}x{size[1]} pixels",
            "; give the size that it expects as --input-size WxH",
        )
        return self._labels_of(np.asarray(output), (image.shape[1], image.shape[0]), where)

    # --- input --------------------------------------------------------------------------------------------------------

    def _set_input(self) -> None:
        """Read the layout, the size and the normalisation of the input."""
        inputs = self._session.get_inputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 4 or inputs[0].type not in _INPUT_TYPES:
            found = ", ".join(f"{entry.name} {entry.type} {entry.shape}" for entry in inputs[:4])
            raise InputError(
                f"{self.path}: is no network for colour images: its inputs are {found}; one input of 4 axes (image, "
                "channels, height, width) of float32, float16 or uint8 can be used"
            )
        self._input, shape = inputs[0].name, [n if isinstance(n, int) else None for n in inputs[0].shape]
        self._input_type = _INPUT_TYPES[inputs[0].type]
        layout = self._options.layout or ("nhwc" if shape[3] == 3 and shape[1] != 3 else "nchw")
        self._is_nhwc = layout == "nhwc"
        channels, height, width = (shape[3], shape[1], shape[2]) if self._is_nhwc else shape[1:]
        if channels not in (3, None) or shape[0] not in (1, None):
            raise InputError(
                f"{self.path}: its input has the shape {shape} in the layout {layout}; one image of three channels is "
                "needed (--layout names the other layout)"
            )
        self._size = self._options.input_size
        if height is not None and width is not None:
            if self._size not in (None, (width, height)):
                raise ConfigError(f"input_size: the input of {self.path} has a fixed size of {width}x{height}")
            self._size = width, height
        if self._size is not None and not 0 < self._size[0] * self._size[1] <= MAX_INPUT_PIXELS:
            raise InputError(f"{self.path}: its input of {self._size[0]}x{self._size[1]} pixels cannot be used")
        self._set_normalisation()

    def _set_normalisation(self) -> None:
        """Read scale, mean, standard deviation and order of the channels."""
        options = self._options
        found = {k.lower(): v for k, v in self._session.get_modelmeta().custom_metadata_map.items()}
        pixel_range = found.get("image.nominalpixelrange", "Normalized_0_1")
        if pixel_range.lower() not in _RANGES:
            raise InputError(f"{self.path}: its Image.NominalPixelRange '{pixel_range[:40]}' is not supported")
        scale, mean, std = _RANGES[pixel_range.lower()]
        if options.scale is not None:
            scale = options.scale
        elif "scale" in found:
            (scale,) = self._numbers(found, "scale", (1,))
        self._scale = np.float32(scale)
        self._mean = np.array(options.mean or self._numbers(found, "mean", (1, 3), mean), dtype=np.float32)
        self._std = np.array(options.std or self._numbers(found, "std", (1, 3), std), dtype=np.float32)
        if not self._std.all():
            raise InputError(f"{self.path}: its metadata 'std' contains 0; give --std")
        order = options.channels or found.get("image.bitmappixelformat", "Rgb8").lower().removesuffix("8")
        if order not in CHANNELS:
            raise InputError(f"{self.path}: its Image.BitmapPixelFormat '{order[:40]}' is not supported")
        self._is_bgr = order == "bgr"
        given = (options.scale, options.mean, options.std)
        if self._input_type is np.uint8 and given != (None, None, None):
            raise ConfigError(f"scale, mean, std: the input of {self.path} takes bytes, which are not normalised")

    def _numbers(
        self, found: Mapping[str, str], key: str, counts: tuple[int, ...], default: float = 0.0
    ) -> tuple[float, ...]:
        """Numbers of a key of the metadata, as a JSON list or separated by commas or blanks."""
        if key not in found:
            return (default,)
        words = re.split(r"[,\s]+", found[key].strip().strip("[]()").strip())
        try:
            numbers = tuple(float(word) for word in words)
        except ValueError:
            numbers = ()
        if len(numbers) not in counts or not np.isfinite(numbers).all():
            raise InputError(f"{self.path}: its metadata '{key}' is no list of numbers; give --{key}")
        return numbers

    def _prepared(self, image: UInt8Array, size: tuple[int, int]) -> npt.NDArray[Any]:
        """Input of the network for an image."""
        if (image.shape[1], image.shape[0]) != size:
            shrinks = size[0] < image.shape[1]
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))
        pixels: npt.NDArray[Any] = image[..., ::-1] if self._is_bgr else image
        if self._input_type is not np.uint8:
            pixels = ((pixels * self._scale - self._mean) / self._std).astype(self._input_type)
        return np.ascontiguousarray((pixels if self._is_nhwc else pixels.transpose(2, 0, 1))[None])

    # --- output -------------------------------------------------------------------------------------------------------

    def _set_output(self) -> None:
        """Choose the output, and check its declared shape and classes."""
        outputs = {entry.name: entry for entry in self._session.get_outputs()}
        name = self._options.output_name or next(iter(outputs))
        if name not in outputs:
            raise ConfigError(f"output_name: {self.path} has no output '{name}'; its outputs are {', '.join(outputs)}")
        self._output = name
        shape = [n if isinstance(n, int) else None for n in outputs[name].shape]
        if np.prod([float(n or 1) for n in shape]) > MAX_OUTPUT_VALUES:
            raise InputError(f"{self.path}: its output '{name}' of the shape {shape} is too large")
        if outputs[name].type in ("tensor(float)", "tensor(float16)", "tensor(double)") and len(shape) == 4:
            channels = shape[3] if self._is_nhwc else shape[1]
            if channels is not None and self._options.output_kind != "labels":
                self._check_count(channels)

    def _check_count(self, count: int) -> None:
        """Raise where an output of ``count`` channels does not fit the class table."""
        if not 2 <= count <= MAX_CLASSES:
            raise InputError(
                f"{self.path}: its output '{self._output}' has {count} channels, one for each class is needed; "
                "--output-name, --layout or --output-kind labels name another reading"
            )
        offset = self._options.label_offset
        self._check_known(range(offset, offset + count), f"gives {count} classes, the raw labels {offset} to "
                                                         f"{offset + count - 1}")  # fmt: skip

    def _check_known(self, labels: Any, what: str) -> None:
        """Raise ConfigError where a raw label is neither of a class nor ignored."""
        unknown = sorted(set(labels) - self._known)
        if unknown:
            shifted = {label + 1 for label in labels}
            hint = ", or --label-offset 1" if self._options.label_offset == 0 and shifted <= self._known else ""
            shown = ", ".join(map(str, unknown[:8])) + (", ..." if len(unknown) > 8 else "")
            raise ConfigError(
                f"{self.path}: {what}; the class table does not have {shown}: give the table of the network's classes"
                f"{hint}, or list these labels in ignored_raw_labels"
            )

    def _labels_of(self, output: npt.NDArray[Any], size: tuple[int, int], where: str) -> Labels:
        """Labels of an image of a size (width, height) from the network's output."""
        kind = self._options.output_kind
        flat = output.ndim == 3 or (output.ndim == 4 and 1 in (output.shape[1], output.shape[3]))
        is_labels = kind == "labels" or (kind == "auto" and (output.dtype.kind in "iu" or flat))
        if output.ndim not in (3, 4) or output.shape[0] != 1 or 0 in output.shape or (is_labels and not flat):
            raise InputError(
                f"{where}: the output '{self._output}' of {self.path} has the shape {list(output.shape)}; scores of "
                "classes have 4 axes (image, classes, height, width), labels 3"
            )
        if not np.isfinite(output).all():
            raise InputError(f"{where}: the output '{self._output}' of {self.path} is not finite")
        if is_labels:
            return self._given_labels(_indices(output), size)
        scores = np.moveaxis(output[0], -1, 0) if self._is_nhwc else output[0]
        self._check_count(len(scores))
        if kind == "auto":
            sums = scores.sum(axis=0)
            is_probability = bool((scores >= 0).all() and (np.abs(sums - 1.0) <= _SUM_TOLERANCE).all())
        else:
            is_probability = kind == "probabilities"
        best, confidences = _best_class(scores, size, is_probability=is_probability)
        return Labels(best + np.int32(self._options.label_offset), confidences)

    def _given_labels(self, indices: npt.NDArray[Any], size: tuple[int, int]) -> Labels:
        """Labels of an output that holds the index of a class for each pixel."""
        if indices.dtype.kind == "f" and not (indices == np.rint(indices)).all():
            raise InputError(
                f"{self.path}: its output '{self._output}' has one channel of fractions, which are no labels; networks "
                "of at least two classes can be used"
            )
        raw = indices.astype(np.int64) + self._options.label_offset
        found = np.unique(raw).tolist()
        self._check_known(found, f"gives the raw labels {found[0]} to {found[-1]}")
        resized = cv2.resize(raw.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
        return Labels(np.asarray(resized).astype(np.int32), None)


def _indices(output: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The image (h, w) of an output with one image and at most one channel."""
    if output.ndim == 3:
        return np.asarray(output[0])
    return np.asarray(output[0, 0] if output.shape[1] == 1 else output[0, ..., 0])


def _best_class(
    scores: npt.NDArray[Any], size: tuple[int, int], *, is_probability: bool
) -> tuple[Int32Array, UInt8Array]:
    """Index of the largest of the scores (C, h, w) for each pixel of an image, and its probability in 255ths.

    Scores are interpolated linearly to the size (width, height). One class is handled at a time, so that no more than
    a few images are in memory.
    """
    best: Float32Array = np.full((size[1], size[0]), -np.inf, dtype=np.float32)
    index = np.zeros(best.shape, dtype=np.int32)
    total = np.zeros(best.shape, dtype=np.float32)
    for number, plane in enumerate(scores):
        score = np.asarray(cv2.resize(plane.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))
        is_better = score > best
        if not is_probability:
            # The sum of exponentials relative to the best score so far, as in a stable softmax.
            ratio = np.exp(np.minimum(score, best) - np.maximum(score, best))
            total = np.where(is_better, total * ratio + 1.0, total + ratio)
        index[is_better] = number
        best[is_better] = score[is_better]
    probability = best if is_probability else 1.0 / total
    return index, np.rint(255.0 * np.clip(probability, 0.0, 1.0)).astype(np.uint8)


def _session(path: Path, threads: int) -> Any:
    """Open an ONNX file for runs on the CPU."""
    runtime = _onnxruntime()
    try:
        num_bytes = path.stat().st_size if path.is_file() else None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if num_bytes is None:
        raise InputError(f"{path}: no such file; give the ONNX file of a network as --model")
    if not 0 < num_bytes <= MAX_MODEL_BYTES:
        raise InputError(f"{path}: a file of {num_bytes} bytes is no ONNX model")
    options = runtime.SessionOptions()
    # Errors become exceptions; the library's own log would go to the terminal.
    options.log_severity_level = 4
    options.intra_op_num_threads = threads
    options.use_deterministic_compute = True
    return _guarded(
        lambda: runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"]),
        f"{path}: is no ONNX model that onnxruntime {runtime.__version__} can read",
    )


def _guarded(step: Callable[[], T], subject: str, remedy: str = "") -> T:
    """Return a step's result; an error of onnxruntime becomes an InputError of one sentence."""
    try:
        return step()
    except (MemoryError, KeyboardInterrupt):
        raise
    except Exception as error:
        # onnxruntime's exceptions have no common base class.
        cause = " ".join(str(error).split())[:_LONGEST_CAUSE]
        raise InputError(f"{subject} ({cause or type(error).__name__}){remedy}") from error


def _onnxruntime() -> ModuleType:
    """Import onnxruntime. Raises ConfigError where it is missing."""
    try:
        import onnxruntime
    except ImportError as error:
        raise ConfigError(
            f"networks are run by the optional package onnxruntime ({error}); install it with: "
            "pip install 'octoreplay[label]'"
        ) from error
    module: ModuleType = onnxruntime
    return module


def as_text(options: NetworkOptions) -> str:
    """Return the options that change labels as JSON."""
    return json.dumps({key: value for key, value in vars(options).items() if key != "threads"}, sort_keys=True)
