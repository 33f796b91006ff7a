from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping import codec
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.quantise import CONTENTS, content_numbers, content_values, is_step, quantised, top_classes
from support.long_suite import examples
from support.octree_factory import cells_of, cube, octree_of

FLOATS = st.floats(width=32)
FINITE = st.floats(-100.0, 100.0, width=32)
STEPS = st.sampled_from([0.05, 0.1, 1e-3, 0.5, 3.0, 1e-40])


def through(values, content, step=0.05):
    """Values (list) after quantisation."""
    return content_values(content_numbers(np.array(values, np.float32), content, step), content, step)


# --- numbers ----------------------------------------------------------------------------------------------------------


@given(values=st.lists(FLOATS), content=st.sampled_from(CONTENTS), step=STEPS)
def test_quantising_is_idempotent(values, content, step):
    once = through(values, content, step)
    assert once.dtype == np.float32
    assert through(once, content, step).tobytes() == once.tobytes()


@given(values=st.lists(FLOATS))
def test_float32_is_kept_bit_for_bit(values):
    assert through(values, "float32").tobytes() == np.array(values, np.float32).tobytes()


@given(values=st.lists(st.floats(-65504.0, 65504.0, width=32)))
def test_float16_against_the_standard_library(values):
    expected = [struct.unpack("<e", struct.pack("<e", value))[0] + 0.0 for value in values]
    numbers = content_numbers(np.array(values, np.float32), "float16", 0.05)
    assert numbers.dtype == np.float16
    assert through(values, "float16").tobytes() == np.array(expected, np.float32).tobytes()


@examples(100)
@given(values=st.lists(FINITE), step=STEPS)
def test_int8_against_integers(values, step):
    step32 = np.float32(step)
    numbers = content_numbers(np.array(values, np.float32), "int8", step)
    assert numbers.dtype == np.int8
    for value, number in zip(values, numbers.tolist(), strict=True):
        assert -127 <= number <= 127
        # The nearest of the 255 multiples, up to the rounding of the float32 division.
        nearest = min(abs(value - n * float(step32)) for n in range(-127, 128))
        assert abs(value - number * float(step32)) <= nearest + 1e-6 * abs(value)
        if abs(value) <= 127 * float(step32):
            assert abs(value - number * float(step32)) <= 0.5 * float(step32) + 1e-6 * abs(value)
        assert float(through([value], "int8", step)[0]) == float(step32 * np.float32(number))


def test_ties_go_to_the_even_step():
    values = [0.25, 0.75, 1.25, -0.25, -0.75, 63.25, 63.75]
    assert content_numbers(np.array(values, np.float32), "int8", 0.5).tolist() == [0, 2, 2, 0, -2, 126, 127]


@pytest.mark.parametrize(("content", "most"), [("float16", 65504.0), ("int8", 127 * float(np.float32(0.05)))])
def test_values_are_clipped_to_the_range_and_nan_becomes_0(content, most):
    values = [1e30, -1e30, np.inf, -np.inf, 65520.0, -65520.0, np.nan, -0.0, -1e-30]
    expected = [most, -most, most, -most, most, -most, 0.0, 0.0, 0.0]
    assert through(values, content).tobytes() == np.array(expected, np.float32).tobytes()


def test_tiny_steps_do_not_overflow():
    assert through([1e38, -1e38, 0.0], "int8", 1e-40).tolist() == [
        pytest.approx(1.27e-38), pytest.approx(-1.27e-38), 0.0,
    ]  # fmt: skip


@pytest.mark.parametrize("step", [0.0, -0.05, math.nan, math.inf, 1e-60, 1e60, 3e36])
def test_invalid_steps_of_int8_are_refused(step):
    assert not is_step(step)
    with pytest.raises(ValueError, match="step"):
        content_numbers(np.zeros(1, np.float32), "int8", step)
    with pytest.raises(ValueError, match="step"):
        content_values(np.zeros(1, np.int8), "int8", step)


def test_largest_step():
    step = float(np.finfo(np.float32).max) / 128
    assert is_step(step)
    assert np.isfinite(through([3e38, -3e38], "int8", step)).all()


def test_unknown_contents_are_refused():
    with pytest.raises(ValueError, match="content 'float64'"):
        quantised(SemanticOctree(0.25, 2), "float64", 0.05)


# --- maps -------------------------------------------------------------------------------------------------------------

VALUES = st.sampled_from([0.0, -5.0, 5.0, -0.3, 1.0, 0.99, 1.01, 1e-30, -3e38, 1e5, 0.1, 7.0])


@st.composite
def cell_maps(draw, num_classes):
    """{key: values} of single cells and cubes, with equal and nearly equal classes."""
    cells = {}
    for _ in range(draw(st.integers(0, 5))):
        edge = draw(st.sampled_from([1, 1, 2, 4, 8]))
        corner = [draw(st.sampled_from([-9, -8, -1, 0, 3, 8])) for _ in range(3)]
        palette = [draw(VALUES) for _ in range(draw(st.integers(1, num_classes)))]
        values = [draw(st.sampled_from(palette)) for _ in range(num_classes)]
        cells.update(cube(corner, edge, values))
    return cells


@examples(60)
@given(cells=cell_maps(num_classes=4), content=st.sampled_from(CONTENTS), step=STEPS)
def test_every_cell_is_quantised(cells, content, step):
    octree = octree_of(cells, num_classes=4)
    octree.find_or_add(np.array([1, 2, 3]))
    octree.revisions[:] = np.arange(octree.num_bricks) + 7
    before = cells_of(octree)
    result = quantised(octree, content, step)
    assert cells_of(result) == {key: through(values, content, step).tobytes() for key, values in cells.items()}
    assert result.codes.tolist() == octree.codes.tolist()
    assert result.revisions.tolist() == octree.revisions.tolist()
    assert (result.resolution, result.num_classes) == (octree.resolution, octree.num_classes)
    # The map itself does not change.
    result.bricks.rows[:] = 77
    result.bricks.values[:] = 77
    assert cells_of(octree) == before


def test_bricks_of_one_value_are_quantised():
    octree = octree_of(cube((0, 0, 0), 4, [0.8, 0.8]))
    assert octree.bricks.blocks[0] < 0
    assert set(cells_of(quantised(octree, "int8", 0.5)).values()) == {np.array([1.0, 1.0], np.float32).tobytes()}


@pytest.mark.parametrize("content", ["float16", "int8"])
def test_quantised_map_can_grow_after_a_map_with_unused_blocks(content):
    """The rows of unused blocks hold the list of unused blocks, not values."""

    def cells(x):
        return cube((x, 0, 0), 8, [1.0, 2.0]) | {(x + k, k, 0): [1.5, k] for k in range(8)}

    octree = octree_of(cells(0))
    one_value = octree_of(cube((0, 0, 0), 8, [1.0, 1.0]))
    octree.overwrite(one_value, np.arange(one_value.num_bricks))
    num_rows = octree.bricks.counters[storage.NUM_ROWS]
    assert num_rows == octree.bricks.counters[storage.NUM_FREE_ROWS] > 0
    result = quantised(octree, content, 0.5)
    # Allocates more blocks of each size than were unused.
    later = octree_of(cells(0) | cells(8) | cells(64))
    result.overwrite(later, np.arange(later.num_bricks))
    assert cells_of(result) == cells_of(later)


@pytest.mark.parametrize("content", ["float16", "int8"])
def test_nan_and_infinity_are_quantised_without_warnings(content):
    octree = octree_of(cube((0, 0, 0), 4, [math.nan, 1.0]) | {(1, 1, 1): [math.inf, -math.inf]})
    result = quantised(octree, content, 0.5)
    packet_format = codec.PacketFormat(content, 0.5)
    decoded = codec.decode_packet(codec.encode_packet(result, packet_format=packet_format))
    most = 65504.0 if content == "float16" else 63.5
    expected = dict.fromkeys(cells_of(octree), np.array([0.0, 1.0], np.float32).tobytes())
    assert cells_of(decoded) == expected | {(1, 1, 1): np.array([most, -most], np.float32).tobytes()}


# --- classes ----------------------------------------------------------------------------------------------------------


def naive_top_classes(values, num_kept):
    """A cell's values with one shared value for all but the largest, computed naively."""
    values = np.array(values, np.float32).tolist()
    if num_kept >= len(values) or len(set(values)) == 1:
        return values
    kept = sorted(range(len(values)), key=lambda c: (-values[c], c))[:num_kept]
    others = [values[c] for c in range(len(values)) if c not in kept]
    shift = max(others)
    shared = shift + math.log(math.fsum(math.exp(value - shift) for value in others) / len(others))
    return [values[c] if c in kept else shared for c in range(len(values))]


@examples(80)
@given(cells=cell_maps(num_classes=5), num_kept=st.integers(1, 7))
def test_top_classes_equal_the_naive_ones_cell_by_cell(cells, num_kept):
    octree = octree_of(cells, num_classes=5)
    octree.revisions[:] = np.arange(octree.num_bricks) + 7
    octree.find_or_add(np.array([1, 2, 3]))
    before = cells_of(octree)
    result = top_classes(octree, num_kept)
    found = {key: np.frombuffer(value, np.float32).tolist() for key, value in cells_of(result).items()}
    assert found.keys() == cells.keys()
    for key, values in cells.items():
        expected = naive_top_classes(values, num_kept)
        assert found[key] == pytest.approx(expected, rel=1e-6, abs=1e-37)
        is_kept = [value in np.array(values, np.float32) for value in expected]
        # Kept values do not change.
        assert [v for v, k in zip(found[key], is_kept, strict=True) if k] == [
            e for e, k in zip(expected, is_kept, strict=True) if k
        ]
        assert len(set(found[key])) <= num_kept + 1
    known = octree.known != 0
    revision_of = dict(zip(octree.codes[known].tolist(), octree.revisions[known].tolist(), strict=True))
    known = result.known != 0
    assert dict(zip(result.codes[known].tolist(), result.revisions[known].tolist(), strict=True)) == revision_of
    assert cells_of(octree) == before
    assert (result.resolution, result.num_classes) == (octree.resolution, octree.num_classes)


def test_top_classes_by_hand():
    octree = octree_of({(0, 0, 0): [1.0, 3.0, 1.0, 3.0, 3.0]}, num_classes=5)

    def values(num_kept):
        return np.frombuffer(cells_of(top_classes(octree, num_kept))[0, 0, 0], np.float32).tolist()

    # Ties go to the lower class; the sum of the other probabilities does not change.
    two, three = (2 * math.e + math.exp(3)) / 3, math.e
    assert values(2) == pytest.approx([math.log(two), 3.0, math.log(two), 3.0, math.log(two)])
    assert values(3) == pytest.approx([math.log(three), 3.0, math.log(three), 3.0, 3.0])
    assert values(5) == values(9) == [1.0, 3.0, 1.0, 3.0, 3.0]


@examples(40)
@given(cells=cell_maps(num_classes=5), num_kept=st.integers(1, 6))
def test_top_classes_are_idempotent(cells, num_kept):
    once = top_classes(octree_of(cells, num_classes=5), num_kept)
    assert codec.encode_packet(top_classes(once, num_kept)) == codec.encode_packet(once)


def test_large_leaves_and_many_classes():
    cells = cube((0, 0, 0), 16, [float(c % 11) for c in range(20)]) | {(0, 0, 0): [float(-c) for c in range(20)]}
    result = cells_of(top_classes(octree_of(cells, num_classes=20), 3))
    for key in ((0, 0, 0), (0, 0, 1), (15, 15, 15)):
        found = np.frombuffer(result[key], np.float32).tolist()
        assert found == pytest.approx(naive_top_classes(cells[key], 3), rel=1e-6)


def test_top_classes_of_nan_and_infinity():
    """Infinite values are sorted by size; NaN comes last and makes the shared value NaN."""
    cells = {
        (0, 0, 0): [1.0, -math.inf, -math.inf], (9, 0, 0): [math.inf, 1.0, math.inf],
        (18, 0, 0): [math.inf, math.inf, math.inf], (27, 0, 0): [math.nan, 2.0, 1.0],
    }  # fmt: skip
    result = cells_of(top_classes(octree_of(cells, num_classes=3), 1))
    assert {key: np.frombuffer(value, np.float32).tolist() for key, value in result.items()} == {
        (0, 0, 0): [1.0, -math.inf, -math.inf],
        (9, 0, 0): [math.inf, math.inf, math.inf],
        (18, 0, 0): [math.inf, math.inf, math.inf],
        (27, 0, 0): [pytest.approx(math.nan, nan_ok=True), 2.0, pytest.approx(math.nan, nan_ok=True)],
    }


def test_empty_map():
    for result in (quantised(SemanticOctree(0.2, 3), "int8", 0.05), top_classes(SemanticOctree(0.2, 3), 2)):
        assert (result.num_bricks, result.resolution, result.num_classes) == (0, 0.2, 3)
