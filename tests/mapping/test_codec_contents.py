"""Contents of packets: exact values, float16 and int8."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.mapping import codec
from octoreplay.mapping.codec import PacketFormat
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.quantise import CONTENTS, quantised
from support.octree_factory import cells_of, cube, octree_of
from support.packets import (
    code_of,
    octrees,
)


@settings(max_examples=60, deadline=None)
@given(
    octree=octrees(), content=st.sampled_from(CONTENTS), step=st.sampled_from([0.05, 0.3, 1e-3]), level=st.booleans(),
    every=st.integers(1, 3),
)  # fmt: skip
def test_quantised_maps_are_restored_bit_for_bit(octree, content, step, level, every):
    octree = quantised(octree, content, step)
    packet_format = PacketFormat(content, step, 1 if level else None)
    packet = codec.encode_packet(octree, packet_format=packet_format)
    decoded = codec.decode_packet(packet)
    assert cells_of(decoded) == cells_of(octree)
    # Equal maps give equal bytes, whatever they were quantised from.
    assert codec.encode_packet(decoded, packet_format=packet_format) == packet
    chosen = np.arange(0, octree.num_bricks, every)
    receiver = SemanticOctree(octree.resolution, octree.num_classes)
    codec.apply_delta(receiver, codec.encode_delta(octree, chosen, packet_format=packet_format))
    codes = set(octree.codes[chosen].tolist())
    assert cells_of(receiver) == {key: value for key, value in cells_of(octree).items() if code_of(key) in codes}


def test_values_that_a_content_cannot_represent_are_refused():
    octree = octree_of({(0, 0, 0): [0.1, 0.15]})
    for content in ("float16", "int8"):
        packet_format = PacketFormat(content, step=0.2)
        with pytest.raises(ValueError, match=f"{content} cannot represent"):
            codec.encode_packet(octree, packet_format=packet_format)
        with pytest.raises(ValueError, match=f"{content} cannot represent"):
            codec.encode_delta(octree, np.arange(1), packet_format=packet_format)
    for content, step in [("float64", 0.2), ("int8", 0.0), ("int8", 1e-60), ("int8", 1e60), ("int8", float("nan"))]:
        with pytest.raises(ValueError, match="step" if content == "int8" else "content 'float64'"):
            codec.encode_packet(SemanticOctree(0.25, 2), packet_format=PacketFormat(content, step))


def test_midpoints_of_merged_values_that_are_no_steps_are_refused():
    octree = octree_of(cube((0, 0, 0), 2, [1.0, 0.0]) | {(1, 1, 1): [1.5, 0.0]})
    packet_format = PacketFormat("int8", step=0.5)
    assert codec.encode_packet(octree, packet_format=packet_format, tolerance=0.4)
    with pytest.raises(ValueError, match="int8 cannot represent"):
        codec.encode_packet(octree, packet_format=packet_format, tolerance=0.5)


def test_siblings_made_equal_by_quantisation_are_one_leaf():
    """Across rows, octets, bricks and classes."""
    rng = np.random.default_rng(5)
    cells = {key: rng.uniform(0.96, 1.04, 3) for key in cube((0, 0, 0), 8, 0.0)}
    octree = octree_of(cells, num_classes=3)
    assert codec.read_header(codec.encode_packet(octree)).num_leaves == 512
    packet_format = PacketFormat("int8", step=0.1)
    packet = codec.encode_packet(quantised(octree, "int8", 0.1), packet_format=packet_format)
    header = codec.read_header(packet)
    assert (header.num_leaves, header.num_vectors) == (1, 0)
    exact = octree_of(dict.fromkeys(cells, float(np.float32(0.1) * np.float32(10))), num_classes=3)
    assert codec.encode_packet(exact, packet_format=packet_format) == packet
