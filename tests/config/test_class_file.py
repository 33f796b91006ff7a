"""Tests of class tables in team files and class files: built-in, merged, ignored, Hydra and Kimera-Semantics."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from octoreplay import cli
from octoreplay.commands import progress
from octoreplay.config.class_file import class_table, with_classes
from octoreplay.config.class_tables.label_rows import BUILT_IN
from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import dump_team, load_team_file, parse_team
from octoreplay.errors import ConfigError
from octoreplay.io.robots.discover import resolve
from octoreplay.records import ClassTable, FrameCounts, SemanticClass
from support.fixture_paths import PAIR
from support.long_suite import long
from support.recordings import RECORDINGS, needs_recordings

HYDRA = RECORDINGS / "semantic_labels" / "hydra_label_spaces"
ROBOTS = "robots: [{id: husky, log: husky.mcap}]\n"
LIST = "classes: [{name: road, raw_labels: 1}, {name: car, raw_labels: [2, 5]}, {name: bus, raw_labels: 3}]\n"


def _parsed(text, folder=Path("/team")):
    return parse_team(ROBOTS + text, name="team.yaml", folder=folder)


def _write_and_read(config):
    text = dump_team(config, Path("/team"))
    again = parse_team(text, name="again", folder=Path("/team"))
    assert again == config
    assert dump_team(again, Path("/team")) == text
    return text


# --- team files -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_tables_are_written_and_read(name):
    config = _parsed(f"classes: {name}\n")
    assert config.classes.num_classes > 25
    _write_and_read(config)


def test_merging_and_ignoring_in_semantickitti():
    config = _parsed(
        "classes: semantickitti\n"
        "merge_classes:\n  vehicle: [car, truck, bus, other-vehicle]\n  ground: [terrain, other-ground]\n"
        "ignore_hits: [person, moving-car]\nignored_raw_labels: [-7, 300]\n"
    )
    by_name = {item.name: item for item in config.classes.classes}
    assert by_name["vehicle"].raw_labels == (10, 13, 18, 20)
    assert by_name["vehicle"].color == (100, 150, 245)
    assert config.classes.names[0] == "vehicle"
    assert not {"car", "truck", "person", "moving-car", "terrain"} & by_name.keys()
    assert config.classes.ignored_raw_labels == (0, 1, -7, 300, 30, 252)
    assert (config.merge_classes, config.ignore_hits) == ((), ())
    assert "merge_classes" not in _write_and_read(config)


def test_merging_and_ignoring_in_a_list():
    config = _parsed(LIST + "merge_classes: {vehicle: [bus, car]}\nignore_hits: road\nignored_raw_labels: [9]\n")
    assert [(c.class_id, c.name, c.raw_labels) for c in config.classes.classes] == [(1, "vehicle", (2, 3, 5))]
    assert config.classes.ignored_raw_labels == (9, 1)
    _write_and_read(config)


def test_edits_without_classes_apply_to_the_logs_classes():
    config = _parsed("merge_classes: {vehicle: [bus, car], plant: tree}\nignore_hits: [person]\n")
    assert config.classes is None
    assert (config.merge_classes, config.ignore_hits) == (
        (("vehicle", ("bus", "car")), ("plant", ("tree",))), ("person",),
    )  # fmt: skip
    _write_and_read(config)


def test_raw_colours_default_to_the_class_colour():
    config = _parsed(
        "classes:\n- {name: a, color: [1, 2, 3]}\n- {name: b}\n- {name: c, color: [7, 7, 7], raw_colors: [[4, 5, 6]]}\n"
        "- {name: d, raw_colors: [[8, 8, 8], [9, 9, 9], [8, 8, 8]]}\nignored_raw_colors: [[0, 0, 1]]\n"
    )
    assert [(c.color, c.raw_colors) for c in config.classes.classes] == [
        ((1, 2, 3), ((1, 2, 3),)), (PALETTE[1], ()), ((7, 7, 7), ((4, 5, 6),)),
        (PALETTE[3], ((8, 8, 8), (9, 9, 9))),
    ]  # fmt: skip
    assert config.classes.ignored_raw_colors == ((0, 0, 1),)
    text = _write_and_read(config)
    assert text.count("raw_colors") == 4
    assert SemanticClass(1, "a", (1, 2, 3), ()).raw_colors == ((1, 2, 3),)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "classes: semanticity\n",
            "'semanticity' is neither a file nor a built-in table .*; did you mean 'semantickitti'",
        ),
        ("classes: SemanticKITTI\n", "did you mean 'semantickitti'"),
        (
            "classes: nyu40\nignored_raw_labels: [5]\n",
            "raw label 5 belongs to 'chair' and is listed in ignored_raw_labels",
        ),
        ("classes: nyu40\nmerge_classes: [chair, sofa]\n", "merge_classes: expects new names"),
        ("classes: nyu40\nmerge_classes: {seat: []}\n", "'seat' needs at least one class"),
        ("classes: nyu40\nmerge_classes: {seat: {a: b}}\n", "merge_classes: expects a list of class names"),
        ("classes: nyu40\nignore_hits: {person: 1}\n", "ignore_hits: expects a list of class names"),
        ("classes: nyu40\nignore_hits: [persn]\n", "ignore_hits: no class is called 'persn'; did you mean 'person'"),
        ("classes: nyu40\nignore_hit: [person]\n", "ignore_hit: unknown key; did you mean 'ignore_hits'"),
        (f"classes: {'road ' * 100}\n", "is neither a file nor a built-in table"),
        ("classes: {name: a}\n", "expects a list of classes, .*, or one of semantickitti, cityscapes"),
        ("classes: [{name: a}, {name: b}, {name: a}]\n", "'a' is listed twice"),
        ("classes: [{name: a, color: 5}]\n", "the color of 'a' must be three whole numbers from 0 to 255, got 5"),
        ("classes: [{name: a, color: [1, 2, true]}]\n", "the color of 'a' must be"),
        ("classes: [{name: a, raw_colors: [1, 2, 3]}]\n", "every raw color of 'a' must be three whole numbers"),
        ("ignored_raw_labels: [5]\n", "ignored_raw_labels: needs 'classes'"),
        ("ignored_raw_colors: [[0, 0, 1]]\n", "ignored_raw_colors: needs 'classes'"),
        ("classes: [{name: a, raw_colors: 7}]\n", "the raw colors of 'a' must be a list"),
        ("classes: [{name: a}]\nignored_raw_colors: [[1, 2]]\n", "every raw color of ignored_raw_colors must be three"),
    ],
)
def test_invalid_class_settings_are_reported_in_one_sentence(text, sentence):
    with pytest.raises(ConfigError, match=f"^team.yaml: .*{sentence}"):
        _parsed(text)


def test_a_long_list_can_be_merged_to_the_maximum():
    entries = [{"name": f"c{i}", "raw_labels": [i]} for i in range(260)]
    rest = ", ".join(f"c{i}" for i in range(7))
    text = f"classes: {entries}\n"
    with pytest.raises(ConfigError, match="at most 254 classes can be mapped, got 260"):
        _parsed(text)
    assert _parsed(text + f"merge_classes: {{rest: [{rest}]}}\n").classes.num_classes == 254


# --- class files ------------------------------------------------------------------------------------------------------


def _run(**fields):
    return RunConfig((RobotConfig("a", (Path("/logs/a.mcap"),)),), **fields)


def test_a_class_file_is_a_list_or_extends_a_table(tmp_path):
    (tmp_path / "list.yaml").write_text("- {name: a, raw_labels: [4]}\n- {name: b, raw_labels: [3]}\n")
    (tmp_path / "base.yaml").write_text("classes: nyu40\nmerge_classes: {seat: [chair, sofa]}\n")
    (tmp_path / "more.yaml").write_text("classes: base.yaml\nignore_hits: [seat]\n")
    assert with_classes(_run(), str(tmp_path / "list.yaml")).classes.names == ("a", "b")
    config = with_classes(_run(classes=class_table([{"name": "x"}])), str(tmp_path / "more.yaml"))
    assert config.classes.num_classes == 38
    assert config.classes.ignored_raw_labels == (0, 5, 6)
    assert config == _run(classes=_parsed("classes: more.yaml\n", tmp_path).classes)


def test_a_file_without_classes_edits_the_existing_ones(tmp_path):
    (tmp_path / "edits.yaml").write_text("merge_classes: {seat: [chair, sofa]}\n")
    old = {"merge_classes": (("x", ("y",)),), "ignore_hits": ("z",)}
    waiting = with_classes(_run(**old), str(tmp_path / "edits.yaml"))
    assert waiting == _run(merge_classes=(("seat", ("chair", "sofa")),))
    nyu = with_classes(_run(**old), "nyu40")
    assert (nyu.merge_classes, nyu.ignore_hits) == ((), ())
    assert with_classes(nyu, str(tmp_path / "edits.yaml")).classes.names[4] == "seat"
    with pytest.raises(ConfigError, match=r"team.yaml: classes: the file 'edits.yaml' has no key 'classes'"):
        _parsed("classes: edits.yaml\n", tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("self.yaml", "classes: self.yaml\n", "self.yaml: classes: the file 'self.yaml' refers to itself"),
        ("word.yaml", "road\n", "word.yaml: a class file is a list of classes, or a mapping with 'classes'"),
        ("team.yaml", "robots: []\n", "team.yaml: the team file has no class settings"),
        ("bad.yaml", "classes: [\n", "bad.yaml: not valid YAML"),
        (
            "hydra.yaml",
            "label_names: [{label: 1, name: a}, {label: 1, name: b}]\n",
            "hydra.yaml: raw label 1 belongs to",
        ),
        ("empty.yaml", "label_names: [{label: 1, name: void}]\n", "empty.yaml: classes: all classes are ignored"),
        ("kimera.csv", "id,name\n", "kimera.csv: a palette begins with"),
        ("binary.csv", "\udcff", "binary.csv: not a class file"),
    ],
)
def test_files_without_classes_are_reported_in_one_sentence(tmp_path, name, text, sentence):
    (tmp_path / name).write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ConfigError, match=sentence):
        with_classes(_run(), str(tmp_path / name))
    with pytest.raises(ConfigError, match="is neither a file nor a built-in table"):
        with_classes(_run(), str(tmp_path))


def test_a_kimera_palette_gives_classes_and_colours(tmp_path):
    (tmp_path / "tesse.csv").write_text("name,red,green,blue,alpha,id\nWall,1,2,3,255,1\nWall_B,1,2,4,255,1\n")
    assert _parsed("classes: tesse.csv\n", tmp_path).classes == ClassTable(
        (SemanticClass(1, "Wall", (1, 2, 3), (1,), ((1, 2, 3), (1, 2, 4))),), (0,), ((255, 255, 255),)
    )


@long
@needs_recordings
def test_all_hydra_label_spaces_can_be_read():
    files = sorted(HYDRA.glob("*.yaml"))
    assert len(files) == 13
    for path in files:
        _write_and_read(_parsed(f"classes: {path.name}\n", HYDRA))


@needs_recordings
@pytest.mark.parametrize(
    ("name", "num_classes", "ignored", "some"),
    [
        ("ade20k_full", 148, (12, 126), {"wall": (0,), "flag": (149,)}),
        ("ade20k_indoor", 18, (0, 19, 20), {"Wall": (1,), "Deformable": (18,)}),
        ("uhumans2_apartment", 18, (0, 20), {"plant": (8, 13), "wall": (19,)}),
        ("uhumans2_subway", 11, (0, 6, 20), {"vending_machine": (1,), "wall": (19,)}),
        ("tesse_cd_office", 17, (0, 17), {"Small office objects": (2,), "Railing": (18,)}),
        ("phoenix", 23, (16,), {"dirt": (0,), "picnic-table": (23,)}),
        ("kitti_360", 28, (0, 1, 2, 3, 4, 5, 23, 24, 25, 26, 27, 28, 30, 31, 32, 33, 43, 45), {"caravan": (29,)}),
    ],
)
def test_hydra_label_spaces_have_hydras_meaning(name, num_classes, ignored, some):
    table = with_classes(_run(), str(HYDRA / f"{name}_label_space.yaml")).classes
    assert (table.num_classes, table.ignored_raw_labels) == (num_classes, ignored)
    assert some.items() <= {item.name: item.raw_labels for item in table.classes}.items()


# --- with logs --------------------------------------------------------------------------------------------------------


def test_classes_of_the_logs_are_merged_and_ignored(tmp_path):
    team = load_team_file(PAIR / "team.yaml")
    first, second, third, *rest = team.classes.names
    waiting = dataclasses.replace(
        team, classes=None, merge_classes=(("both", (second, third)),), ignore_hits=(first,)
    )  # fmt: skip
    config = resolve(waiting)
    assert config.classes.names == ("both", *rest)
    assert team.classes.classes[0].raw_labels[0] in config.classes.ignored_raw_labels
    assert (config.merge_classes, config.ignore_hits) == ((), ())
    _write_and_read(config.to_config())


def test_the_option_classes_accepts_a_table_or_a_file(tmp_path, capsys):
    first, second, *rest = load_team_file(PAIR / "team.yaml").classes.names
    (tmp_path / "edits.yaml").write_text(f"merge_classes: {{both: [{first}, {second}]}}\n")
    saved = tmp_path / "team.yaml"
    logs = [str(path) for path in sorted(PAIR.glob("*.mcap"))]
    for inputs, classes, names in (
        (logs, str(tmp_path / "edits.yaml"), ("both", *rest)),
        ([str(PAIR / "team.yaml")], "nyu40", None),
    ):
        assert cli._exit_code(["run", *inputs, "--classes", classes, "--save-team", str(saved), "--force"]) == 0
        assert load_team_file(saved).classes.names == (names or with_classes(_run(), "nyu40").classes.names)
    assert cli._exit_code(["run", *logs, "--classes", "nyu41", "--save-team", str(saved), "--force"]) == 2
    assert "did you mean 'nyu40'" in capsys.readouterr().err


def test_unknown_colours_are_reported_as_colours():
    counts = FrameCounts(unknown_label_pixels={7: 1}, unknown_colors={0x0A0B0C: 1200, 255: 3})
    assert list(progress.lost_data({"husky_1": counts})) == [
        "husky_1: 1 pixels or points with labels without a class were ignored: 7; --classes gives them one",
        (
            "husky_1: 1,203 pixels or points with colours without a class were ignored: #0000ff, #0a0b0c;"
            " --classes gives them one"
        ),
    ]
