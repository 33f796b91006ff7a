"""Lossy reduction of maps for packets: coarser numbers, and the most probable classes only."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree, octree_from_streams
from octoreplay.mapping.streams import TreeStreams, leaf_list, leaf_values
from octoreplay.records import Float32Array

CONTENTS = ("float32", "float16", "int8")
"""Number formats of packets, in the order of their codes in the header."""
FLOAT16_MAX = 65504.0
INT8_MAX = 127


def is_step(step: float) -> bool:
    """Return True where all multiples of an int8's ``step`` are finite float32 numbers."""
    with np.errstate(all="ignore"):
        return bool(np.float32(step) > 0 and np.isfinite(np.float32(INT8_MAX) * np.float32(step)))


def content_numbers(values: Float32Array, content: str, step: float) -> npt.NDArray[Any]:
    """Return the numbers (n,) of dtype ``content`` that represent ``values`` (n,) float32 in a packet.

    ``float32`` keeps the values. ``float16`` is the nearest number, ``int8`` the nearest multiple of the float32
    ``step``, ties to even. Values beyond the range become its ends, NaN becomes 0, and -0 becomes 0. Raises ValueError
    for an unknown content and for a step that ``is_step`` refuses.
    """
    if content == "float32":
        return values
    with np.errstate(all="ignore"):
        if content == "float16":
            halves = _clipped(values, FLOAT16_MAX).astype(np.float16)
            return halves + np.float16(0.0)
        _check_int8(content, step)
        return _clipped(np.rint(values / np.float32(step)), INT8_MAX).astype(np.int8)


def _clipped(values: Float32Array, limit: float) -> Float32Array:
    """Clip values (n,) to [-limit, limit]; NaN becomes 0."""
    clipped: Float32Array = np.nan_to_num(np.clip(values, -limit, limit))
    return clipped


def content_values(numbers: npt.NDArray[Any], content: str, step: float) -> Float32Array:
    """Return the values (n,) float32 that ``content_numbers`` (n,) represent."""
    if content == "int8":
        _check_int8(content, step)
        return numbers.astype(np.float32) * np.float32(step)
    return numbers.astype(np.float32, copy=False)


def _check_int8(content: str, step: float) -> None:
    """Raise ValueError for an unknown content and for an invalid step of int8."""
    if content not in CONTENTS:
        raise ValueError(f"content '{content}' is unknown; choose one of {', '.join(CONTENTS)}")
    if not is_step(step):
        raise ValueError(
            f"step {step:g}: multiples 1 to {INT8_MAX} of the step of int8 must be positive float32 numbers"
        )


def quantised(octree: SemanticOctree, content: str, step: float) -> SemanticOctree:
    """Return a copy with the values that a receiver of packets with this ``content`` gets.

    Values are those of ``content_numbers``. Layout and revisions do not change; the encoder merges equal leaves. Raises
    ValueError like ``content_numbers``.
    """
    # octree.copy() would copy unused blocks, and the list of unused blocks in their rows must not be quantised.
    copy = SemanticOctree(octree.resolution, octree.num_classes)
    copy.overwrite(octree, np.arange(octree.num_bricks))
    copy.revisions[:] = octree.revisions
    used_rows = copy.bricks.rows[: copy.bricks.counters[storage.NUM_ROWS]]
    for values in (copy.bricks.values[: copy.num_bricks], used_rows):
        values[:] = content_values(content_numbers(values, content, step), content, step)
    return copy


def top_classes(octree: SemanticOctree, num_kept: int) -> SemanticOctree:
    """Return a copy in which every cell keeps its ``num_kept`` >= 1 largest log-odds; ties go to the lower class.

    All other classes get one value, log(mean(exp(h_c))) over them, which keeps the sum of their probabilities. Cells in
    which all classes are equal do not change; nothing changes with ``num_kept`` >= the number of classes.
    """
    if num_kept >= octree.num_classes:
        return octree.copy()
    streams = octree.streams()
    _, _, is_vector = leaf_list(streams)
    vectors = leaf_values(_vector_leaves(streams, is_vector), np.ones(len(streams.masks), np.bool_), octree.num_classes)
    order = np.argsort(-vectors, axis=1, kind="stable")
    others = np.take_along_axis(vectors, order[:, num_kept:], axis=1).astype(np.float64)
    with np.errstate(all="ignore"):
        # Shifted by the largest value, so that nothing overflows; an infinite value is the result itself.
        largest = others.max(axis=1)
        spread = np.log(np.exp(others - largest[:, None]).mean(axis=1))
        shared = np.where(np.isinf(largest), largest, largest + spread).astype(np.float32)
    is_kept = np.zeros(vectors.shape, np.bool_)
    np.put_along_axis(is_kept, order[:, :num_kept], values=True, axis=1)
    values = streams.values.copy()
    values[is_vector] = shared
    masks = np.packbits(is_kept, axis=1, bitorder="little")
    result = octree_from_streams(
        TreeStreams(streams.words, values, masks, vectors[is_kept]), octree.resolution, octree.num_classes
    )
    result.revisions[:] = octree.revisions[octree.find(result.codes)]
    return result


def _vector_leaves(streams: TreeStreams, is_vector: npt.NDArray[np.bool_]) -> TreeStreams:
    """Return the vector leaves of a stream, without words."""
    return streams._replace(words=streams.words[:0], values=streams.values[is_vector])
