from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.class_tables.edits import MAX_CLASSES, edited
from octoreplay.errors import ConfigError
from octoreplay.records import ClassTable, SemanticClass
from support.long_suite import examples

NAMES = ("road", "car", "tree", "truck", "sky", "person")
TABLE = ClassTable(
    tuple(SemanticClass(i + 1, name, (i, i, i), (20 - i, 30 + i)) for i, name in enumerate(NAMES)), (255,), ((9, 9, 9),)
)


def test_a_merged_class_has_the_position_and_colour_of_its_first_member():
    table = edited(TABLE, (("vehicle", ("truck", "car")), ("ground", ("road",))), ())
    assert [(c.class_id, c.name, c.color, c.raw_labels, c.raw_colors) for c in table.classes] == [
        (1, "ground", (0, 0, 0), (20, 30), ((0, 0, 0),)), (2, "tree", (2, 2, 2), (18, 32), ((2, 2, 2),)),
        (3, "vehicle", (3, 3, 3), (17, 19, 31, 33), ((3, 3, 3), (1, 1, 1))),
        (4, "sky", (4, 4, 4), (16, 34), ((4, 4, 4),)), (5, "person", (5, 5, 5), (15, 35), ((5, 5, 5),)),
    ]  # fmt: skip
    assert (table.ignored_raw_labels, table.ignored_raw_colors) == ((255,), ((9, 9, 9),))


def test_labels_and_colours_of_ignored_classes_are_ignored():
    table = edited(TABLE, (("thing", ("sky", "tree")),), ("thing", "person", "thing"))
    assert [(c.class_id, c.name) for c in table.classes] == [(1, "road"), (2, "car"), (3, "truck")]
    assert table.ignored_raw_labels == (255, 16, 18, 32, 34, 15, 35)
    assert table.ignored_raw_colors == ((9, 9, 9), (4, 4, 4), (2, 2, 2), (5, 5, 5))


def test_without_edits_the_table_is_unchanged():
    assert edited(TABLE, (), ()) == TABLE


@examples(100)
@given(st.lists(st.lists(st.sampled_from(NAMES), min_size=1), max_size=4), st.sets(st.sampled_from(NAMES), max_size=5))
def test_every_raw_label_has_a_class_or_is_ignored(groups, ignore):
    taken: set[str] = set()
    merge = []
    for index, group in enumerate(groups):
        names = tuple(name for name in dict.fromkeys(group) if name not in taken)
        taken.update(names)
        if names:
            merge.append((f"new {index}", names))
    kept = [name for name in NAMES if name not in taken and name not in ignore]
    if not kept and not merge:
        return
    table = edited(TABLE, tuple(merge), sorted(ignore - taken))
    becomes = {name: new for new, names in merge for name in names}
    meaning = {raw: item.name for item in table.classes for raw in item.raw_labels}
    for item in TABLE.classes:
        for raw in item.raw_labels:
            if item.name in ignore - taken:
                assert raw in table.ignored_raw_labels
                assert raw not in meaning
            else:
                assert meaning[raw] == becomes.get(item.name, item.name)
    assert [item.class_id for item in table.classes] == list(range(1, len(kept) + len(merge) + 1))


@pytest.mark.parametrize(
    ("merge", "ignore", "sentence"),
    [
        ((("vehicle", ("car", "trruck")),), (), "merge_classes: no class is called 'trruck'; did you mean 'truck'?"),
        ((("vehicle", ("car",)), ("big", ("car",))), (), "'car' is merged into both 'vehicle' and 'big'"),
        ((("vehicle", ("car", "car")),), (), "'car' is merged into both 'vehicle' and 'vehicle'"),
        ((("tree", ("car",)),), (), "merge_classes: 'tree' is already a class of the table"),
        ((), ("Person",), "ignore_hits: no class is called 'Person'; did you mean 'person'?"),
        ((), ("qqq",), "ignore_hits: no class is called 'qqq'; classes: road, car, tree, truck, sky, person"),
        ((("vehicle", ("car",)),), ("car",), "ignore_hits: merge_classes makes 'car' part of 'vehicle'"),
        ((), NAMES, "all classes are ignored"),
    ],
)
def test_invalid_edits_are_reported_in_one_sentence(merge, ignore, sentence):
    with pytest.raises(ConfigError, match=sentence.replace("?", r"\?")):
        edited(TABLE, merge, ignore)


def test_a_merged_class_can_have_the_name_of_a_member():
    assert edited(TABLE, (("car", ("truck", "car")),), ()).names == ("road", "tree", "car", "sky", "person")
    assert edited(TABLE, (("car", ("truck", "car")),), ("car",)).names == ("road", "tree", "sky", "person")


def test_too_many_classes_are_refused_unless_merged():
    many = ClassTable(tuple(SemanticClass(i + 1, f"c{i}", (0, 0, 0), (i,)) for i in range(300)))
    with pytest.raises(ConfigError, match="at most 254 classes can be mapped, got 300; merge some with merge_classes"):
        edited(many, (), ())
    rest = tuple(f"c{i}" for i in range(MAX_CLASSES - 1, 300))
    assert edited(many, (("rest", rest),), ()).num_classes == MAX_CLASSES
    assert edited(many, (), rest).num_classes == MAX_CLASSES - 1
