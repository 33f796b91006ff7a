"""Colours from the robots' evidence, default colours, and exports in several files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from octoreplay.config.class_file import class_table
from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.mapping.contradiction import CellContradiction
from octoreplay.records import LeafTable
from octoreplay.report.cell_colors import CONTRADICTION_COLORS, default_color
from octoreplay.report.export import export_map
from support import leaf_list
from support.result_factory import leaf_table, state, write_result

LEAVES = leaf_table()


def cells(rows: list[int], log_odds: list[list[float]]) -> bytes:
    """Evidence in some of the leaves."""
    return leaf_list.encode(LeafTable(LEAVES.centers[rows], LEAVES.sizes[rows], np.array(log_odds, np.float32)))


def fill(writer: ResultWriter) -> None:
    """Maps of both robots with all leaves; alpha has seen leaves 0, 1 and 3, beta leaves 0, 1 and 2."""
    for robot_id in ("alpha", "beta"):
        writer.write_state(state(robot_id, 0, 1, leaf_list.encode(LEAVES), key=True))
    writer.write_evidence(state("alpha", 0, 4, cells([0, 1, 3], [[2.0, 0.0], [2.0, 0.0], [-0.3, -0.3]]), key=True))
    writer.write_evidence(state("beta", 0, 4, cells([0, 1, 2], [[0.0, 2.0], [-2.0, -2.0], [1.0, 0.0]]), key=True))


@pytest.fixture
def result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    leaf_list.install(monkeypatch)
    return write_result(tmp_path, fill)


def colors_of(result: Path, color: str | None, **options: object) -> tuple[list[list[int]], str]:
    """Colours of all leaves, and the comment on them."""
    path = result.with_name("map.ply")
    export_map(result, path, color=color, free=True, **options)
    data = PlyData.read(path)
    return np.column_stack([data["vertex"][name] for name in ("red", "green", "blue")]).tolist(), data.comments[-1]


def test_seen_by_is_the_only_robot_with_scans_of_a_leaf(result: Path) -> None:
    colors, comment = colors_of(result, "seen-by")
    alpha, beta = list(PALETTE[0]), list(PALETTE[1])
    assert colors == [[205, 205, 205], [205, 205, 205], beta, alpha]
    assert f"alpha {PALETTE[0]}, beta {PALETTE[1]} for leaves with scans of one robot; grey: several robots" in comment


def test_contradictions_of_the_evidence_have_a_colour_each(result: Path) -> None:
    colors, comment = colors_of(result, "contradiction")
    kinds = [CellContradiction.OTHER_LABEL, CellContradiction.CLEAR, *[CellContradiction.UNCOMPARED] * 2]
    assert colors == [list(CONTRADICTION_COLORS[kind][1]) for kind in kinds]
    assert "occupied and firmly free (204, 0, 0)" in comment


@pytest.mark.parametrize("color", ["seen-by", "contradiction"])
def test_times_without_evidence_are_refused(result: Path, color: str) -> None:
    with pytest.raises(InputError, match=r"no evidence of robot 'alpha'.*ask for the end.*--evidence-every"):
        export_map(result, result.with_name("map.ply"), color=color, at=2.0)
    assert not result.with_name("map.ply").exists()


def test_maps_with_classes_are_coloured_by_label(result: Path) -> None:
    assert colors_of(result, None)[1] == "color: label (the classes' own)"


# --- several files ---------------------------------------------------------------------------------------------------


def test_each_class_has_a_file(result: Path) -> None:
    written = export_map(result, result.with_name("map.ply"), split="class", free=True)
    assert {path.name: count for path, count in written.items()} == {
        "map-0-free.ply": 1, "map-1-ground.ply": 2, "map-2-tree.ply": 1,
    }  # fmt: skip
    for path, count in written.items():
        labels = PlyData.read(path)["vertex"]["label"]
        assert labels.tolist() == [int(path.name[4])] * count


def test_each_robot_has_a_file(result: Path) -> None:
    written = export_map(result, result.with_name("map.npz"), split="robot")
    assert {path.name: count for path, count in written.items()} == {"map-alpha.npz": 3, "map-beta.npz": 3}
    assert not result.with_name("map.npz").exists()


def test_a_failed_split_writes_no_file(result: Path) -> None:
    result.with_name("map-beta.ply").mkdir()
    with pytest.raises(Exception, match=r"map-beta\.ply: cannot be written"):
        export_map(result, result.with_name("map.ply"), split="robot")
    assert not result.with_name("map-alpha.ply").exists()


@pytest.mark.parametrize(
    ("name", "options", "sentence"),
    [
        ("map.bt", {"split": "class"}, r"map\.bt: a \.bt file holds occupied and free space together; split it by rob"),
        ("map.ply", {"split": "robot", "robot": "beta"}, "leave out robot 'beta'"),
        ("map.ply", {"split": "tick"}, "split: 'tick' is not one of class, robot"),
        ("map.ply", {"heights": (2.0, 1.0)}, "heights: the lowest, 2, must be below the highest, 1"),
        ("map.stl", {}, r"must end in one of \.ply, \.npz, \.glb"),
    ],
)
def test_wrong_options_are_refused(result: Path, name: str, options: dict[str, object], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        export_map(result, result.with_name(name), **options)


def test_heights_limit_every_format(result: Path) -> None:
    path = result.with_name("map.ply")
    assert export_map(result, path, heights=(0.25, 9.0)) == {path: 2}
    for name in ("map.ply", "map.yaml", "map.glb"):
        with pytest.raises(InputError, match="the map holds nothing from 5 m to 6 m; give other heights"):
            export_map(result, result.with_name(name), heights=(5.0, 6.0))


def test_maps_of_a_single_class_are_coloured_by_height() -> None:
    assert default_color(class_table([{"name": "occupied"}])) == "height"
    assert default_color(class_table([{"name": "ground"}, {"name": "tree"}])) == "label"
