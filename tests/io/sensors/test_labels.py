from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from log_factory import ros2
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.sensors.labels import OCCUPIED, LabelLookup, class_table_from_names, label_names
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
def test_every_raw_label_means_what_the_table_says(kind, values):
    limits = np.iinfo(kind)
    raw = np.array([v for v in values if limits.min <= v <= limits.max], kind)
    lookup = LabelLookup(TABLE)
    class_ids = lookup.class_ids(raw, "here")
    assert class_ids.dtype == np.uint8
    assert class_ids.tolist() == [MEANING.get(v, 0) for v in raw.tolist()]
    unknown = [v for v in raw.tolist() if v not in MEANING and v != -1]
    assert lookup.unknown == {v: unknown.count(v) for v in unknown}


@pytest.mark.parametrize("kind", ["u1", "u2", "i4"])
def test_shape_is_kept_and_unknown_ones_add_up(kind):
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
        ({"a": {}}, "names 0 classes"),
        ({"a": {raw: f"class {raw}" for raw in range(300) if raw != 255}}, "names 299 classes"),
    ],
)
def test_tables_that_cannot_be_united_are_refused(names, sentence):
    with pytest.raises(ConfigError, match=sentence):
        class_table_from_names(names)


def test_label_info_names():
    assert label_names(ros2.label_info(0, {4: "x", 2: "y"})) == {4: "x", 2: "y"}


def test_plain_occupancy_has_one_class():
    assert OCCUPIED.names == ("occupied",)
