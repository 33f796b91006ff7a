from __future__ import annotations

import pytest

from octoreplay.config.class_tables.label_rows import (
    BUILT_IN,
    LabelRow,
    built_in_rows,
    hydra_rows,
    kimera_rows,
    table_of_rows,
)
from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.errors import ConfigError

# From the data sets' own files (class_tables/SOURCES.md): number of labels, ignored labels, and some labels.
FACTS = {
    "semantickitti": (34, {0, 1}, {
        10: ("car", (100, 150, 245)), 40: ("road", (255, 0, 255)), 70: ("vegetation", (0, 175, 0)),
        99: ("other-object", (50, 255, 255)), 252: ("moving-car", (100, 150, 245)),
        255: ("moving-motorcyclist", (150, 30, 90)), 259: ("moving-other-vehicle", (0, 0, 255)),
    }),
    "cityscapes": (34, {0, 1, 2, 3, 4, 5, 6}, {
        5: ("dynamic", (111, 74, 0)), 7: ("road", (128, 64, 128)), 18: ("polegroup", (153, 153, 153)),
        19: ("traffic light", (250, 170, 30)), 26: ("car", (0, 0, 142)), 33: ("bicycle", (119, 11, 32)),
    }),
    "coco-stuff": (183, {255}, {
        0: ("person", (220, 20, 60)), 11: ("street sign", None), 89: ("toothbrush", (191, 162, 208)),
        91: ("banner", (255, 255, 128)), 168: ("tree", (107, 142, 35)), 93: ("branch", None),
        181: ("wood", None), 255: ("unlabeled", (0, 0, 0)),
    }),
    "ade20k": (151, {0}, {
        0: ("other objects", None), 1: ("wall", (120, 120, 120)), 7: ("road", (140, 140, 140)),
        13: ("person", (150, 5, 61)), 21: ("car", (0, 102, 200)), 150: ("flag", (92, 0, 255)),
    }),
    "nyu40": (41, {0}, {
        1: ("wall", (174, 199, 232)), 24: ("refridgerator", (255, 127, 14)), 31: ("person", (120, 185, 128)),
        34: ("sink", (112, 128, 144)), 40: ("otherprop", (100, 85, 144)),
    }),
}  # fmt: skip

SHARED = {
    "semantickitti": {
        ("car", "moving-car"), ("bus", "moving-bus"), ("truck", "moving-truck"), ("person", "moving-person"),
        ("bicyclist", "moving-bicyclist"), ("motorcyclist", "moving-motorcyclist"),
        ("on-rails", "other-vehicle", "moving-on-rails", "moving-other-vehicle"),
    },
    "cityscapes": {("pole", "polegroup")},
    "ade20k": {("road", "skyscraper")},
}  # fmt: skip
"""Classes that share a colour in their data set; docs/classes.md lists them."""


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_tables_match_their_data_sets(name):
    number, ignored, facts = FACTS[name]
    rows = built_in_rows(name)
    assert len(rows) == len({row.raw_label for row in rows}) == len({row.name for row in rows}) == number
    assert [row.raw_label for row in rows] == sorted(row.raw_label for row in rows)
    assert {row.raw_label for row in rows if row.is_ignored} == ignored
    by_label = {row.raw_label: row for row in rows}
    for raw_label, (meaning, color) in facts.items():
        assert (by_label[raw_label].name, by_label[raw_label].color) == (meaning, color)


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_tables_have_the_documented_colours(name):
    table = table_of_rows(built_in_rows(name), PALETTE)
    assert table.num_classes == FACTS[name][0] - len(FACTS[name][1])
    assert set(table.ignored_raw_labels) == FACTS[name][1]
    owners: dict[tuple[int, int, int], tuple[str, ...]] = {}
    for item in table.classes:
        for color in item.raw_colors:
            owners[color] = (*owners.get(color, ()), item.name)
    assert {names for names in owners.values() if len(names) > 1} == SHARED.get(name, set())
    assert not owners.keys() & set(table.ignored_raw_colors)
    without = [item.name for item in table.classes if not item.raw_colors]
    assert len(without) == (49 if name == "coco-stuff" else 0)


def test_rows_of_one_name_are_one_class():
    rows = (
        LabelRow(3, "plant", (1, 1, 1)), LabelRow(1, "Void", (5, 5, 5)), LabelRow(2, "wall"),
        LabelRow(9, "plant", (2, 2, 2)), LabelRow(3, "plant", (1, 1, 1)), LabelRow(7, "person", (2, 2, 2), True),
    )  # fmt: skip
    table = table_of_rows(rows, PALETTE)
    assert [(c.class_id, c.name, c.color, c.raw_labels, c.raw_colors) for c in table.classes] == [
        (1, "plant", (1, 1, 1), (3, 9), ((1, 1, 1), (2, 2, 2))), (2, "wall", PALETTE[1], (2,), ()),
    ]  # fmt: skip
    # The person's colour is also the plant's.
    assert (table.ignored_raw_labels, table.ignored_raw_colors) == ((1, 7), ((5, 5, 5),))
    with pytest.raises(ConfigError, match="raw label 3 belongs to both 'plant' and 'wall'"):
        table_of_rows((LabelRow(3, "plant"), LabelRow(3, "wall")), PALETTE)


def test_hydra_label_spaces_ignore_dynamic_and_invalid_labels():
    rows = hydra_rows(
        {
            "total_semantic_labels": 5, "dynamic_labels": [4], "invalid_labels": [0], "object_labels": [2],
            "label_names": [
                {"label": 0, "name": "sky"}, {"label": 2, "name": "chair", "name_descriptive": "a chair"},
                {"label": 4, "name": "human"},
            ],
        }
    )  # fmt: skip
    assert rows == (LabelRow(0, "sky", None, True), LabelRow(2, "chair"), LabelRow(4, "human", None, True))


@pytest.mark.parametrize(
    "content",
    [
        {"label_names": None}, {"label_names": 5}, {"label_names": ["wall"]}, {"label_names": [{"label": 1}]},
        {"label_names": [{"label": "a", "name": "b"}]}, {"label_names": [{"label": True, "name": "b"}]},
        {"label_names": [], "dynamic_labels": 3}, {"label_names": [], "invalid_labels": ["x"]},
    ],
)  # fmt: skip
def test_bad_label_spaces_are_refused(content):
    with pytest.raises(ConfigError, match=r"_(names|labels): expects"):
        hydra_rows(content)


PALETTE_CSV = """name,red,green,blue,alpha,id
Graphics,57,177,210,255,0
Chair_1,10,20,30,255,3
Plane,0,255,0,255,2
"Chair, large",11,20,30,255,3
Plane,255,20,127,255,4
"""


def test_kimera_palettes_have_one_class_per_id():
    table = table_of_rows(kimera_rows(PALETTE_CSV + "\n"), PALETTE)
    assert [(c.name, c.color, c.raw_labels, c.raw_colors) for c in table.classes] == [
        ("Chair_1", (10, 20, 30), (3,), ((10, 20, 30), (11, 20, 30))),
        ("Plane", (0, 255, 0), (2,), ((0, 255, 0),)),
        ("Plane 4", (255, 20, 127), (4,), ((255, 20, 127),)),
    ]
    assert table.ignored_raw_labels == (0,)
    assert table.ignored_raw_colors == ((255, 255, 255), (57, 177, 210))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "begins with the line name,red"), ("id,name\n1,wall\n", "begins with the line name,red"),
        (PALETTE_CSV + "BG,\n", "line 7: expects name,red,green,blue,alpha,id, got 'BG,'"),
        (PALETTE_CSV + "x,256,0,0,255,1\n", "line 7: expects"), (PALETTE_CSV + "x,0,0,0,255,-1\n", "line 7: expects"),
        (PALETTE_CSV + "Graphics,1,2,3,255,\n", "line 7: expects"),
        (PALETTE_CSV + "\nx,1,2,3,255," + "9" * 5000, "line 8: expects"),
    ],
)  # fmt: skip
def test_bad_palettes_are_refused(text, sentence):
    with pytest.raises(ConfigError, match=sentence):
        table_of_rows(kimera_rows(text), PALETTE)
