"""What is left of a map in a lossy packet: coarser numbers, and the likeliest classes only."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree, TreeStreams, leaf_list, leaf_values, octree_from_streams
from octoreplay.records import Float32Array

CONTENTS = ("float32", "float16", "int8")
"""The numbers that a packet may hold, in the order of their number in its header."""
FLOAT16_MAX = 65504.0
INT8_MAX = 127


def is_step(step: float) -> bool:
    """True for a step of int8 with which all its values are float32 numbers."""
    with np.errstate(all="ignore"):
        return bool(np.float32(step) > 0 and np.isfinite(np.float32(INT8_MAX) * np.float32(step)))


def content_numbers(values: Float32Array, content: str, step: float) -> npt.NDArray[Any]:
    """The numbers, of the dtype ``content``, that stand for ``values`` (n,) float32 in a packet.

    ``float32`` keeps the values as they are. Of ``float16`` and ``int8`` (a value's nearest multiple of the float32
    ``step``, ties to the even one) each is the nearest there is, so values beyond their range are at its ends; what is
    no number is 0, and 0 has no sign. Raises ValueError for an unknown content and a step that ``is_step`` refuses.
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
    """Values (n,) from -limit to limit; 0 for what is no number."""
    clipped: Float32Array = np.nan_to_num(np.clip(values, -limit, limit))
    return clipped


def content_values(numbers: npt.NDArray[Any], content: str, step: float) -> Float32Array:
    """The values (n,) float32 that ``content_numbers`` (n,) stand for."""
    if content == "int8":
        _check_int8(content, step)
        return numbers.astype(np.float32) * np.float32(step)
    return numbers.astype(np.float32, copy=False)


def _check_int8(content: str, step: float) -> None:
    """Refuse an unknown content, and a step that int8 cannot have."""
    if content not in CONTENTS:
        raise ValueError(f"content '{content}': a packet holds {', '.join(CONTENTS)}")
    if not is_step(step):
        raise ValueError(f"step {step:g}: {INT8_MAX} steps of int8 must be positive float32 numbers")


def quantised(octree: SemanticOctree, content: str, step: float) -> SemanticOctree:
    """A copy in which every value is one that ``content`` can hold: what a receiver of such a packet has.

    The number of a value is that of ``content_numbers``; the layout and the revisions stay, and equal leaves are merged
    by the encoder.

    Raises ValueError as ``content_numbers`` does.
    """
    # A plain copy would keep unused blocks, whose rows hold no values but the list of them.
    copy = SemanticOctree(octree.resolution, octree.num_classes)
    copy.overwrite(octree, np.arange(octree.num_bricks))
    copy.revisions[:] = octree.revisions
    used_rows = copy.bricks.rows[: copy.bricks.counters[storage.NUM_ROWS]]
    for values in (copy.bricks.values[: copy.num_bricks], used_rows):
        values[:] = content_values(content_numbers(values, content, step), content, step)
    return copy


def top_classes(octree: SemanticOctree, num_kept: int) -> SemanticOctree:
    """A copy in which every cell keeps its ``num_kept`` >= 1 largest log-odds, the lower class where they tie.

    All other classes get one value, log(mean(exp(h_c))) over them, which keeps their probability together. A cell
    whose classes are all equal stays as it is, and so does every cell that has no more classes than are kept.
    """
    if num_kept >= octree.num_classes:
        return octree.copy()
    streams = octree.streams()
    _, _, is_vector = leaf_list(streams)
    vectors = leaf_values(_vector_leaves(streams, is_vector), np.ones(len(streams.masks), np.bool_), octree.num_classes)
    order = np.argsort(-vectors, axis=1, kind="stable")
    others = np.take_along_axis(vectors, order[:, num_kept:], axis=1).astype(np.float64)
    with np.errstate(all="ignore"):
        # Shifted by the largest one, so that nothing overflows; an infinite one is the mean.
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
    """The leaves whose classes differ, without their words."""
    return streams._replace(words=streams.words[:0], values=streams.values[is_vector])
