from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.sensors.images import LabelImage
from octoreplay.io.sensors.labels import LOSSY_DISTANCE, OCCUPIED, LabelLookup, class_table_from_names
from octoreplay.records import ClassTable, SemanticClass

TABLE = ClassTable(
    (
        SemanticClass(1, "ground", (0, 0, 0), (0, 3)),
        SemanticClass(2, "tree", (0, 0, 0), (40000,)),
        SemanticClass(3, "far", (0, 0, 0), (100000,)),
    ),
    (9,),
)
MEANING = {0: 1, 3: 1, 40000: 2, 100000: 3, 9: 0, 255: 0, 65535: 0}


@given(
    st.sampled_from(["u1", "u2", "i2", "i4", "i8"]),
    st.lists(st.sampled_from([0, 3, 9, 255, 40000, 65535, 100000, 5, 77, 300, -1, -5, 2**31 - 1]), max_size=30),
)
def test_raw_labels_map_to_the_classes_of_the_table(kind, values):
    limits = np.iinfo(kind)
    raw = np.array([v for v in values if limits.min <= v <= limits.max], kind)
    lookup = LabelLookup(TABLE)
    class_ids = lookup.class_ids(raw, "here")
    assert class_ids.dtype == np.uint8
    # Bits above the lowest 16 are instance ids.
    meaning = {v: MEANING.get(v, MEANING.get(v & 0xFFFF) if v > 0xFFFF else None) for v in raw.tolist()}
    assert class_ids.tolist() == [meaning[v] or 0 for v in raw.tolist()]
    unknown = [v for v in raw.tolist() if meaning[v] is None and v != -1 and (v <= 0xFFFF or v & 0xFFFF != 0xFFFF)]
    assert lookup.unknown == {v: unknown.count(v) for v in unknown}


@pytest.mark.parametrize("kind", ["u1", "u2", "i4"])
def test_the_shape_is_kept_and_unknown_labels_are_counted(kind):
    lookup = LabelLookup(TABLE)
    raw = np.array([[3, 8, 8], [8, 3, 0]], kind)
    for _ in range(2):
        assert lookup.class_ids(raw, "here").tolist() == [[1, 0, 0], [0, 1, 1]]
    assert lookup.unknown == {8: 6}


def test_the_table_may_use_255():
    table = ClassTable((SemanticClass(1, "sky", (0, 0, 0), (255,)),))
    assert LabelLookup(table).class_ids(np.array([255], np.uint8), "here").tolist() == [1]


def test_strict_refuses_unknown_labels_only():
    lookup = LabelLookup(TABLE, strict=True)
    lookup.class_ids(np.array([0, 3, 9, 255], np.uint8), "here")
    with pytest.raises(InputError, match=r"^here: raw label 8 is not in the class table"):
        lookup.class_ids(np.array([3, 8], np.uint8), "here")


def test_class_tables_are_united_by_name():
    table = class_table_from_names(
        {"a": {2: "tree", 1: "ground", 255: "sky"}, "b": {1: "ground", 5: "car", 6: "tree", 0: "Unlabeled"}}
    )
    assert [(c.class_id, c.name, c.raw_labels) for c in table.classes] == [
        (1, "ground", (1,)), (2, "tree", (2, 6)), (3, "car", (5,)),
    ]  # fmt: skip
    assert table.ignored_raw_labels == (0, 255)


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        ({"a": {1: "tree"}, "b": {1: "car"}}, "raw label 1 is 'tree' for robot 'a' and 'car' for robot 'b'"),
        ({"a": {1: "tree", 0: "sky"}, "b": {0: "void"}}, "raw label 0 is 'sky' for robot 'a' and unlabelled"),
        ({"a": {}}, "names no class"),
    ],
)
def test_tables_that_cannot_be_united_are_refused(names, sentence):
    with pytest.raises(ConfigError, match=sentence):
        class_table_from_names(names)


@pytest.mark.parametrize("kind", ["u1", "u2", "i8"])
def test_ids_of_images_and_points_map_to_the_same_classes(kind):
    raw = np.array([[3, 8, 9], [0, 0, 255]], kind)
    lookup = LabelLookup(TABLE)
    np.testing.assert_array_equal(lookup.of_image(LabelImage(raw), "here"), [[1, 0, 0], [1, 1, 0]])
    np.testing.assert_array_equal(lookup.of_points(raw[0].astype(np.int64), "here"), [1, 0, 0])
    assert lookup.unknown == {8: 2}


@pytest.mark.parametrize("raw", [-5, 1 << 40, 10**30])
def test_strange_raw_labels_make_a_table(raw):
    table = class_table_from_names({"a": {raw: "odd", 1: "tree"}})
    lookup = LabelLookup(table)
    assert lookup.class_ids(np.array([1, 7], np.int64), "here").tolist() == [table.names.index("tree") + 1, 0]


def test_plain_occupancy_has_one_class():
    assert OCCUPIED.names == ("occupied",)


# --- colours ----------------------------------------------------------------------------------------------------------

COLORS = ClassTable(
    (
        SemanticClass(1, "ground", (200, 100, 0), (1,)),
        SemanticClass(2, "tree", (0, 150, 0), (2,), ((0, 150, 0), (0, 160, 0), (10, 255, 3))),
        SemanticClass(3, "made up", (9, 9, 9), (3,), ()),
        SemanticClass(4, "wall", (255, 255, 255), (4,)),
    ),
    ignored_raw_colors=((0, 0, 255),),
)
COLOR_MEANING = {
    (0, 0, 0): 0, (0, 0, 255): 0, (200, 100, 0): 1, (0, 150, 0): 2, (0, 160, 0): 2, (10, 255, 3): 2, (255, 255, 255): 4,
}  # fmt: skip


COLOR_LOOKUP = LabelLookup(COLORS)


def number(color):
    return color[0] << 16 | color[1] << 8 | color[2]


@given(st.lists(st.sampled_from([*COLOR_MEANING, (9, 9, 9), (0, 100, 200), (200, 100, 1), (255, 0, 0)]), max_size=40))
def test_colours_map_to_the_classes_of_the_table(colors):
    lookup = COLOR_LOOKUP
    lookup.unknown_colors = {}
    class_ids = lookup.class_ids_of_colors(np.array(colors, np.uint8).reshape(-1, 3), "here", is_lossy=False)
    assert class_ids.dtype == np.uint8
    assert class_ids.tolist() == [COLOR_MEANING.get(color, 0) for color in colors]
    unknown = [number(color) for color in colors if color not in COLOR_MEANING]
    assert lookup.unknown_colors == {key: unknown.count(key) for key in unknown}
    assert lookup.unknown == {}


def test_colours_of_images_keep_their_shape_and_memory_order():
    image = np.array([[(200, 100, 0), (7, 8, 9)], [(0, 160, 0), (0, 0, 0)]], np.uint8)
    lookup = LabelLookup(COLORS)
    for given_image in (image, np.asfortranarray(image), image[::-1][::-1]):
        assert lookup.class_ids_of_colors(given_image, "here", is_lossy=False).tolist() == [[1, 0], [2, 0]]
    assert lookup.unknown_colors == {0x070809: 3}
    assert lookup.class_ids_of_colors(image[:, :0], "here", is_lossy=True).shape == (2, 0)


def nearest_class(color):
    """Naive version: the class of the nearest colour within half of its distance to the next one and within 40."""
    distance = {known: math.dist(color, known) for known in COLOR_MEANING}
    for known, class_id in COLOR_MEANING.items():
        least = min(math.dist(known, other) for other in COLOR_MEANING if other != known)
        if distance[known] < least / 2 and distance[known] <= LOSSY_DISTANCE:
            assert distance[known] == min(distance.values())
            return class_id
    return None


def test_lossy_colours_match_within_half_of_the_distance_to_the_next():
    rng = np.random.default_rng(3)
    known = np.array(list(COLOR_MEANING))
    near = known[rng.integers(len(known), size=4000)] + rng.integers(-45, 46, (4000, 3)) * rng.random((4000, 1))
    edges = [(0, 155, 0), (0, 154, 0), (0, 156, 0), (200, 140, 0), (200, 141, 0), (160, 100, 0), (159, 100, 0)]
    colors = np.concatenate([near.round().clip(0, 255), edges, known]).astype(np.uint8)
    lookup = LabelLookup(COLORS)
    class_ids = lookup.class_ids_of_colors(colors, "here", is_lossy=True)
    expected = [nearest_class(color) for color in colors.tolist()]
    assert class_ids.tolist() == [class_id or 0 for class_id in expected]
    assert 500 < expected.count(None) < 3000
    unknown = [number(color) & 0xF0F0F0 for color, c in zip(colors.tolist(), expected, strict=True) if c is None]
    assert lookup.unknown_colors == {key: unknown.count(key) for key in unknown}


def test_a_class_may_be_black():
    table = ClassTable((SemanticClass(1, "night", (0, 0, 0), ()),))
    lookup = LabelLookup(table)
    image = np.array([(0, 0, 0), (0, 0, 30), (90, 0, 0)], np.uint8)
    assert lookup.class_ids_of_colors(image, "here", is_lossy=False).tolist() == [1, 0, 0]
    assert lookup.class_ids_of_colors(image, "here", is_lossy=True).tolist() == [1, 1, 0]


def test_a_photograph_does_not_fill_the_memory_with_colours():
    lookup = LabelLookup(COLORS)
    rng = np.random.default_rng(0)
    for _ in range(3):
        lookup.class_ids_of_colors(rng.integers(1, 256, (200, 200, 3), dtype=np.uint8), "here", is_lossy=False)
    assert len(lookup.unknown_colors) <= 2 * 4096
    assert 119_900 < sum(lookup.unknown_colors.values()) <= 120_000


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        (
            ClassTable((SemanticClass(1, "road", (1, 2, 255), ()), SemanticClass(2, "tower", (1, 2, 255), ()))),
            "#0102ff is both 'road' and 'tower'; join them with merge_classes",
        ),
        (ClassTable((SemanticClass(1, "a", (1, 2, 3), ()),), (), ((1, 2, 3),)), "#010203 is both 'a' and ignored"),
        (
            ClassTable((SemanticClass(1, "a", (1, 2, 3), (), ()),)),
            "no class has a colour; give every class",
        ),
    ],
)
def test_ambiguous_colours_are_refused_when_they_are_used(table, sentence):
    lookup = LabelLookup(table)
    assert lookup.class_ids(np.array([255], np.uint8), "here").tolist() == [0]
    for is_lossy in (False, True):
        with pytest.raises(ConfigError, match=sentence):
            lookup.class_ids_of_colors(np.zeros((1, 3), np.uint8), "here", is_lossy=is_lossy)


def test_strict_refuses_unknown_colours_of_lossless_images_only():
    lookup = LabelLookup(COLORS, strict=True)
    image = np.array([(200, 100, 0), (1, 10, 171)], np.uint8)
    with pytest.raises(InputError, match=r"^here: colour #010aab is not in the class table; add it to a class's"):
        lookup.class_ids_of_colors(image, "here", is_lossy=False)
    assert lookup.class_ids_of_colors(image, "here", is_lossy=True).tolist() == [1, 0]
    assert lookup.unknown_colors == {0x0000A0: 1}


def test_colours_of_a_label_info_match_no_image():
    table = class_table_from_names({"a": {1: "ground", 2: "tree"}})
    assert [item.raw_colors for item in table.classes] == [(), ()]
