"""Comparisons of two results against a twin that compares dictionaries of cells."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.class_file import class_table
from octoreplay.config.resolved import ResolvedRobot
from octoreplay.errors import ConfigError, InputError
from octoreplay.evaluate import comparison
from octoreplay.evaluate.comparison import LabelChange, compare_results
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.io.text_files import json_text
from octoreplay.mapping.codec import encode_packet
from octoreplay.records import CENTRAL
from support import octree_factory
from support.long_suite import examples, long
from support.result_factory import CLASSES, state, summary, team, tick_metrics

RESOLUTION = 0.25
NAMES = ("unknown", "free", "ground", "tree")
GROUND, TREE, FREE = [2.0, 0.5], [-1.0, 3.0], [-2.0, -3.0]


def stored(folder: Path, maps: dict[str, dict], *, classes=CLASSES, late=None, interrupted=False, **parameters) -> Path:
    """A result with maps {robot: {key: values}} after tick 1 and the maps ``late`` after tick 3."""
    folder.mkdir(exist_ok=True)
    config = team(folder)
    robots = tuple(
        ResolvedRobot(name, (folder / "alpha.bag",), depth_topic="/depth", pose_topic="/odom")
        for name in maps if name != CENTRAL
    )  # fmt: skip
    parameters = {"resolution": RESOLUTION, **parameters}
    config = dataclasses.replace(config, robots=robots, classes=classes).with_parameters(parameters)
    path = folder / "result.mcap"
    ticks = [tick_metrics(tick) for tick in (1, 2, 3)]
    with ResultWriter(path, config) as writer:
        for tick in ticks:
            writer.write_metrics(tick)
        for number, (at, content) in enumerate(((1, maps), (3, late or {}))):
            for robot_id, cells in content.items():
                octree = octree_factory.octree_of(
                    cells, num_classes=classes.num_classes, resolution=parameters["resolution"]
                )
                writer.write_state(state(robot_id, number, at, encode_packet(octree), key=True))
        if interrupted:
            raise KeyboardInterrupt
        writer.complete(summary(ticks))
    return path


def pair(tmp_path: Path, a: dict, b: dict, **options) -> comparison.MapDifference:
    """Comparison of two maps of one robot."""
    paths = [stored(tmp_path / name, {"alpha": cells}) for name, cells in (("a", a), ("b", b))]
    return compare_results(*paths, **options).maps[0]


# --- against the twin -------------------------------------------------------------------------------------------------

levels = st.sampled_from([-1.0, -0.5, 0.0, 0.25, 2.0])
values = st.tuples(levels, levels)
cells = st.dictionaries(st.tuples(*[st.integers(-5, 4)] * 3), values, max_size=12)
cubes = st.lists(st.tuples(st.tuples(*[st.sampled_from([-8, -4, 0, 2, 4])] * 3), st.sampled_from([1, 2, 4]), values),
                 max_size=3)  # fmt: skip


@st.composite
def maps(draw):
    """Cells of a random map with leaves of several sizes."""
    content = {}
    for corner, edge, value in draw(cubes):
        content |= octree_factory.cube(corner, edge, value)
    return content | draw(cells)


def label(cells: dict, key) -> str:
    """Label of a cell; a tie goes to free, then to the lower class."""
    if key not in cells:
        return "unknown"
    scores = (0.0, *cells[key])
    return NAMES[1 + scores.index(max(scores))]


def twin(a: dict, b: dict, tolerance: float) -> dict:
    """Numbers of a comparison of two maps, counted cell by cell."""
    everywhere = set(a) | set(b)
    differences = {
        key: max(abs(x - y) for x, y in zip(a.get(key, (0, 0)), b.get(key, (0, 0)), strict=True)) for key in everywhere
    }
    changes: dict[tuple[str, str], int] = {}
    for key in everywhere:
        if label(a, key) != label(b, key):
            ends = label(a, key), label(b, key)
            changes[ends] = changes.get(ends, 0) + 1
    over = {key for key in everywhere if differences[key] > tolerance}
    differing = over | (set(a) ^ set(b))
    corners = [None, None]
    if differing:
        corners = [tuple(RESOLUTION * min(axis) for axis in zip(*differing, strict=True)),
                   tuple(RESOLUTION * (max(axis) + 1) for axis in zip(*differing, strict=True))]  # fmt: skip
    return {
        "num_cells_a_only": len(set(a) - set(b)), "num_cells_b_only": len(set(b) - set(a)),
        "num_cells_both": len(set(a) & set(b)),
        "num_relabelled": sum(label(a, key) != label(b, key) for key in set(a) & set(b)),
        "label_changes": changes, "largest_difference": max(differences.values(), default=0.0),
        "num_over_tolerance": len(over), "num_differing": len(differing), "lower": corners[0], "upper": corners[1],
        "worst": {key for key in everywhere if differences[key] == max(differences.values()) > 0},
    }  # fmt: skip


@examples(60)
@given(a=maps(), b=maps(), tolerance=st.sampled_from([0.0, 0.25, 0.5, 1.0]), shared=st.booleans())
def test_every_number_equals_that_of_the_twin(tmp_path_factory, a, b, tolerance, shared) -> None:
    b = {**a, **b} if shared else b
    found = dataclasses.asdict(pair(tmp_path_factory.mktemp("pair"), a, b, tolerance=tolerance))
    expected = twin(a, b, tolerance)
    worst = expected.pop("worst")
    changes = {(one["label_a"], one["label_b"]): one["num_cells"] for one in found["label_changes"]}
    counts = list(changes.values())
    assert len(changes) == len(found["label_changes"])
    assert counts == sorted(counts, reverse=True)
    assert {name: found[name] for name in expected} | {"label_changes": changes} == expected
    if worst:
        assert tuple(math.floor(x / RESOLUTION) for x in found["largest_at"]) in worst
    else:
        assert found["largest_at"] is None


@examples(30)
@given(a=maps(), b=maps(), tolerance=st.sampled_from([0.0, 0.25, 1.0]))
def test_exchanged_results_have_the_same_difference(tmp_path_factory, a, b, tolerance) -> None:
    folder = tmp_path_factory.mktemp("pair")
    one = pair(folder, a, b, tolerance=tolerance)
    other = compare_results(folder / "b" / "result.mcap", folder / "a" / "result.mcap", tolerance=tolerance).maps[0]
    assert (one.num_cells_a_only, one.num_cells_b_only) == (other.num_cells_b_only, other.num_cells_a_only)
    assert {(c.label_a, c.label_b, c.num_cells) for c in one.label_changes} == {
        (c.label_b, c.label_a, c.num_cells) for c in other.label_changes
    }
    same = ("num_cells_both", "num_relabelled", "largest_difference", "largest_at", "num_over_tolerance",
            "num_differing", "lower", "upper")  # fmt: skip
    assert [getattr(one, name) for name in same] == [getattr(other, name) for name in same]


@long
@examples(20)
@given(a=maps(), b=maps())
def test_a_larger_tolerance_does_not_find_more_differences(tmp_path_factory, a, b) -> None:
    folder = tmp_path_factory.mktemp("pair")
    pair(folder, a, b)
    paths = [folder / name / "result.mcap" for name in "ab"]
    found = [compare_results(*paths, tolerance=tolerance) for tolerance in (0.0, 0.1, 0.25, 0.5, 1.0, 5.0)]
    over = [one.maps[0].num_over_tolerance for one in found]
    assert over == sorted(over, reverse=True)
    assert over[-1] == 0
    verdicts = [one.is_same for one in found]
    assert verdicts == sorted(verdicts)
    assert verdicts[-1] == (set(a) == set(b))


# --- by hand ----------------------------------------------------------------------------------------------------------


def test_differences_of_four_cells_by_hand(tmp_path: Path) -> None:
    a = {(0, 0, 0): GROUND, (1, 0, 0): GROUND, (-4, 0, 2): FREE}
    b = {(0, 0, 0): GROUND, (1, 0, 0): TREE, (7, 7, 7): TREE}
    found = pair(tmp_path, a, b)
    assert found == comparison.MapDifference(
        robot_id="alpha", tick_a=1, tick_b=1, seconds_a=1.0, seconds_b=1.0, num_cells_a_only=1, num_cells_b_only=1,
        num_cells_both=2, num_relabelled=1,
        label_changes=(
            LabelChange("unknown", "tree", 1), LabelChange("free", "unknown", 1), LabelChange("ground", "tree", 1),
        ),
        largest_difference=3.0, largest_at=found.largest_at, num_over_tolerance=3, num_differing=3,
        lower=(-1.0, 0.0, 0.0), upper=(2.0, 2.0, 2.0),
    )  # fmt: skip
    assert found.largest_at in {(0.375, 0.125, 0.125), (-0.875, 0.125, 0.625), (1.875, 1.875, 1.875)}


def test_a_result_equals_itself(tmp_path: Path) -> None:
    path = stored(tmp_path, {"alpha": {(0, 0, 0): GROUND}, CENTRAL: {(0, 0, 0): TREE}})
    found = compare_results(path, path)
    assert found.is_same
    assert [one.robot_id for one in found.maps] == ["alpha", CENTRAL]
    assert (found.same_inputs, found.settings, found.is_complete_a) == (True, (), True)


def test_a_difference_equal_to_the_tolerance_is_no_difference(tmp_path: Path) -> None:
    a, b = {(0, 0, 0): (0.5, 0.25)}, {(0, 0, 0): (0.5, 0.5)}
    assert pair(tmp_path, a, b, tolerance=0.25).num_differing == 0
    assert pair(tmp_path, a, b, tolerance=0.2499).num_differing == 1
    assert pair(tmp_path, a, {}, tolerance=100.0).num_differing == 1


def test_robots_of_only_one_result(tmp_path: Path) -> None:
    cell = {(0, 0, 0): GROUND}
    a = stored(tmp_path / "a", {"alpha": cell, "beta": cell})
    b = stored(tmp_path / "b", {"alpha": cell, "gamma": cell, CENTRAL: cell})
    found = compare_results(a, b)
    assert (found.is_same, found.only_a, found.only_b) == (False, ("beta",), ("gamma", CENTRAL))
    assert [one.robot_id for one in found.maps] == ["alpha"]
    assert "robots" in [one.name for one in found.settings]
    assert compare_results(a, b, robot="alpha").is_same
    beta = compare_results(a, b, robot="beta")
    assert (beta.is_same, beta.maps, beta.only_a) == (False, (), ("beta",))
    with pytest.raises(
        InputError, match=r"a/result\.mcap, .*b/result\.mcap: neither has a map of robot 'delta'; robots: alpha, beta"
    ):
        compare_results(a, b, robot="delta")


def test_a_time_selects_the_maps_of_both_results(tmp_path: Path) -> None:
    first, second = {(0, 0, 0): GROUND}, {(0, 0, 0): TREE}
    a = stored(tmp_path / "a", {"alpha": first}, late={"alpha": second})
    b = stored(tmp_path / "b", {"alpha": first}, late={"alpha": first})
    assert not compare_results(a, b).is_same
    early = compare_results(a, b, at=2.5)
    assert early.is_same
    assert (early.maps[0].tick_a, early.maps[0].seconds_b) == (1, 1.0)
    with pytest.raises(InputError, match="no map of robot 'alpha' is stored up to the time asked for"):
        compare_results(a, b, at=0.5)


def test_an_unknown_cell_has_the_prior_of_its_result(tmp_path: Path) -> None:
    cell = {(0, 0, 0): (0.5, 0.5)}
    a = stored(tmp_path / "a", {"alpha": cell})
    b = stored(tmp_path / "b", {"alpha": cell}, prob_free=0.6)
    prior = math.log(0.4 / 2 / 0.6)
    assert compare_results(a, b).maps[0].largest_difference == pytest.approx(-prior, abs=1e-12)
    empty = stored(tmp_path / "c", {"alpha": {}})
    assert compare_results(empty, b).maps[0].largest_difference == pytest.approx(abs(0.5 + prior), abs=1e-7)


def test_different_settings_are_listed_and_equal_inputs_recognised(tmp_path: Path) -> None:
    cell = {"alpha": {(0, 0, 0): GROUND}}
    a = stored(tmp_path / "a", cell)
    b = stored(tmp_path / "b", cell, rule="gradient", gamma=0.25)
    found = compare_results(a, b)
    assert found.is_same
    assert {one.name: (one.value_a, one.value_b) for one in found.settings} == {
        "rule": ("bayes", "gradient"), "gamma": (0.5, 0.25), "miss": (-19661 * 2.0**-16, -307 * 2.0**-10),
    }  # fmt: skip
    other = stored(tmp_path / "c", cell)
    assert compare_results(a, other).same_inputs
    moved = tmp_path / "moved"
    shutil.copytree(tmp_path / "c", moved)
    assert compare_results(a, moved / "result.mcap").same_inputs


def test_different_logs_are_different_inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = {"alpha": {(0, 0, 0): GROUND}}
    a = stored(tmp_path / "a", cell)
    plain = Path.write_bytes
    monkeypatch.setattr(Path, "write_bytes", lambda path, data: plain(path, data + b"!"))
    assert compare_results(a, stored(tmp_path / "b", cell)).same_inputs is False


# --- refused inputs ---------------------------------------------------------------------------------------------------


def test_different_resolutions_and_classes_are_refused(tmp_path: Path) -> None:
    cell = {(0, 0, 0): GROUND}
    a = stored(tmp_path / "a", {"alpha": cell})
    fine = stored(tmp_path / "fine", {"alpha": cell}, resolution=0.1)
    with pytest.raises(InputError, match=r"fine/result.mcap: the resolution is 0.1 m, and 0.25 m in .*a/result.mcap;"):
        compare_results(a, fine)
    other = class_table([{"name": "ground"}, {"name": "car"}])
    with pytest.raises(InputError, match=r"class 2 is 'car', and 'tree' in .*a/result.mcap"):
        compare_results(a, stored(tmp_path / "other", {"alpha": cell}, classes=other))
    three = class_table([{"name": "ground"}, {"name": "tree"}, {"name": "car"}])
    more = stored(tmp_path / "more", {"alpha": {(0, 0, 0): [1.0, 2.0, 3.0]}}, classes=three)
    with pytest.raises(InputError, match=r"class 3 is '\(none\)', and 'car' in .*more/result.mcap"):
        compare_results(more, a)


def test_a_file_that_is_not_a_result_is_refused(tmp_path: Path) -> None:
    a = stored(tmp_path / "a", {"alpha": {}})
    with pytest.raises(
        InputError, match=r"not a finished MCAP file, or damaged; give the OUT.mcap of 'octoreplay run'"
    ):
        compare_results(a, tmp_path / "a" / "alpha.bag")
    with pytest.raises(InputError, match="cannot be read: No such file"):
        compare_results(tmp_path / "none.mcap", a)


def test_the_result_of_an_interrupted_run_can_be_compared(tmp_path: Path) -> None:
    cell = {"alpha": {(0, 0, 0): GROUND}}
    whole = stored(tmp_path / "a", cell)
    with pytest.raises(KeyboardInterrupt):
        stored(tmp_path / "b", cell, interrupted=True)
    found = compare_results(tmp_path / "b" / "result.partial.mcap", whole)
    assert (found.is_same, found.is_complete_a, found.is_complete_b) == (True, False, True)


@pytest.mark.parametrize("tolerance", [-0.1, math.nan, math.inf])
def test_a_tolerance_that_is_negative_or_not_finite_is_refused(tmp_path: Path, tolerance: float) -> None:
    with pytest.raises(ConfigError, match=r"tolerance: .* is not a finite number of at least 0"):
        compare_results(tmp_path / "a.mcap", tmp_path / "b.mcap", tolerance=tolerance)


@pytest.mark.parametrize("at", [math.nan, math.inf, 1e30])
def test_a_time_that_is_not_finite_or_too_large_is_refused(tmp_path: Path, at: float) -> None:
    with pytest.raises(ConfigError, match=r"at: .* is not a number of seconds"):
        compare_results(tmp_path / "a.mcap", tmp_path / "b.mcap", at=at)


def test_a_comparison_as_json(tmp_path: Path) -> None:
    a = stored(tmp_path / "a", {"alpha": {(0, 0, 0): GROUND}})
    b = stored(tmp_path / "b", {"alpha": {(0, 0, 0): TREE}, "beta": {}}, bounds=(-1.0, 2.5))
    content = json.loads(json_text(compare_results(a, b)))
    assert content["maps"][0]["label_changes"] == [{"label_a": "ground", "label_b": "tree", "num_cells": 1}]
    assert content["only_b"] == ["beta"]
    assert {"name": "bounds", "value_a": [], "value_b": [-1.0, 2.5]} in content["settings"]
