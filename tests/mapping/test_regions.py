"""Parts of octrees against dictionaries of cells."""

from __future__ import annotations

import math
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping import regions as regions_module
from octoreplay.mapping.codec import apply_delta, decode_packet, encode_delta, encode_packet
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.key_box import KeyBox, first_keys
from octoreplay.mapping.octree import KEY_BITS, keys_to_codes
from octoreplay.mapping.regions import coarsened, cut, leaf_tiles
from support.long_suite import examples
from support.octree_factory import cells_of, cube, octree_of

RESOLUTION = 0.25
NUM_CLASSES = 3


@st.composite
def cell_maps(draw):
    """{key: values} of cubes with few distinct values, so that leaves of many sizes occur."""
    values = st.sampled_from([-5.0, -0.25, 0.0, 1.0, 2.0])
    cells = {}
    for _ in range(draw(st.integers(0, 5))):
        edge = draw(st.sampled_from([1, 2, 3, 4, 8, 16]))
        corner = [edge * draw(st.integers(-3, 2)) + draw(st.sampled_from([0, 0, 1])) for _ in range(3)]
        equal = draw(st.booleans())
        content = [draw(values)] * NUM_CLASSES if equal else [draw(values) for _ in range(NUM_CLASSES)]
        cells.update(cube(corner, edge, content))
    return cells


@st.composite
def regions(draw):
    """Boxes in metres, with sides on borders and centres of cells, and beyond the map."""
    side = st.one_of(st.integers(-40, 40).map(lambda n: n * RESOLUTION / 2), st.floats(-13, 13))
    low, high = np.sort([[draw(side) for _ in range(3)] for _ in range(2)], axis=0)
    return (*low.tolist(), *high.tolist())


def content_of(cells):
    """{key: bytes of the values}, as ``cells_of`` gives them."""
    return {key: np.asarray(values, np.float32).tobytes() for key, values in cells.items()}


def inside(key, region):
    """The rule of a run: the cell's centre is in the half-open box."""
    centers = [(k + 0.5) * RESOLUTION for k in key]
    return all(low <= c < high for low, c, high in zip(region[:3], centers, region[3:], strict=True))


@examples(60)
@given(cells=cell_maps(), region=regions())
def test_a_cut_keeps_the_cells_with_centres_in_the_box(cells, region):
    octree, box = octree_of(cells, num_classes=NUM_CLASSES), KeyBox.of(region, RESOLUTION)
    expected = {key: values for key, values in cells.items() if inside(key, region)}
    piece = cut(octree, box)
    assert cells_of(piece) == content_of(expected)
    # Its leaves are those of a map that never had any other cell.
    alone = octree_of(expected, num_classes=NUM_CLASSES).leaves()
    for name in ("centers", "sizes", "log_odds"):
        np.testing.assert_array_equal(getattr(piece.leaves(), name), getattr(alone, name))


@examples(40)
@given(cells=cell_maps(), later=cell_maps(), region=regions())
def test_packets_decoded_in_a_box_have_the_same_cells_in_it(cells, later, region):
    box = KeyBox.of(region, RESOLUTION)
    octree = octree_of(cells, num_classes=NUM_CLASSES)
    changed = octree_of({**cells, **later}, num_classes=NUM_CLASSES)
    codes = np.unique(keys_to_codes(np.array(list(later) or np.empty((0, 3)), np.int64).reshape(-1, 3)) >> 6)
    delta = encode_delta(changed, changed.find(codes))
    part = decode_packet(encode_packet(octree), box=box)
    assert cells_of(cut(part, box)) == cells_of(cut(octree, box))
    apply_delta(part, delta, box=box)
    assert cells_of(cut(part, box)) == cells_of(cut(changed, box))


def test_bricks_outside_of_the_box_are_not_decoded():
    octree = octree_of({(4 * n, 0, 0): [float(n), 1.0] for n in range(100)})
    box = KeyBox.of((10.0, 0.0, 0.0, 12.0, 1.0, 1.0), RESOLUTION)
    assert decode_packet(encode_packet(octree), box=box).num_bricks == 2


def test_limits_of_the_key_space():
    reach = storage.KEY_OFFSET
    assert first_keys([-math.inf, 0.0, 0.125, 0.126, math.inf], RESOLUTION).tolist() == [-reach, 0, 0, 1, reach]
    assert KeyBox.of((0.0, 0.0, 0.2, 1.0, 1.0, 0.3), RESOLUTION).is_empty
    assert not KeyBox.of((0.0, 0.0, 0.1, 1.0, 1.0, 0.3), RESOLUTION).is_empty


def coarse_twin(cells, level):
    """{coarse key: values}: of the known cell with the largest value, the first one in Morton order of equal ones."""
    found = {}
    keys = sorted(cells, key=lambda key: int(keys_to_codes(np.array([key]))[0]))
    for key in keys:
        coarse = tuple(k >> level for k in key)
        if coarse not in found or max(cells[key]) > max(found[coarse]):
            found[coarse] = cells[key]
    return found


@examples(60)
@given(
    cells=cell_maps(), level=st.integers(0, 18), prior=st.sampled_from([-1.0, 0.0, 0.5]),
    part_bricks=st.sampled_from([1, 3, 1 << 16]),
)  # fmt: skip
def test_a_coarse_cell_has_the_values_of_its_most_occupied_cell(cells, level, prior, part_bricks):
    octree = octree_of(cells, num_classes=NUM_CLASSES)
    with mock.patch.object(regions_module, "PART_BRICKS", part_bricks):
        coarse = coarsened(octree, KEY_BITS - level)
    assert coarse.resolution == RESOLUTION * 2**level
    twin = coarse_twin(cells, level)
    assert cells_of(coarse) == content_of(twin)
    occupied = {tuple(k >> level for k in key) for key, values in cells.items() if max(values) + prior > 0}
    assert {key for key, values in twin.items() if max(values) + prior > 0} == occupied


@examples(24)
@given(cells=cell_maps().filter(bool), edge=st.sampled_from([1.1, 2.0, 6.25, 50.0]))
def test_tiles_divide_the_leaves(cells, edge):
    octree = octree_of(cells, num_classes=NUM_CLASSES)
    leaves = octree.leaves()
    tiles = list(leaf_tiles(leaves, RESOLUTION, edge))
    places = [(tile.row, tile.column) for tile in tiles]
    assert places == sorted(set(places))
    total = 0
    for tile in tiles:
        x, y = tile.column * edge, tile.row * edge
        region = (x, y, -math.inf, (tile.column + 1) * edge, (tile.row + 1) * edge, math.inf)
        alone = cut(octree, KeyBox.of(region, RESOLUTION)).leaves()
        np.testing.assert_array_equal(tile.centers, alone.centers)
        np.testing.assert_array_equal(tile.sizes, alone.sizes)
        np.testing.assert_array_equal(leaves.log_odds[tile.leaves], alone.log_odds)
        total += (tile.sizes**3).sum()
    assert total == pytest.approx((leaves.sizes**3).sum())
