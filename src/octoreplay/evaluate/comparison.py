"""Two results side by side: whether their maps are the same, and where and by how much they differ.

All numbers are over finest cells, whatever leaves they are stored in (docs/cli.md).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Set
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.evaluate.runs import CommonRuns, bounding_box, common_runs
from octoreplay.log_odds import best_labels
from octoreplay.mapping.octree import LeafSpans, codes_to_keys
from octoreplay.records import CENTRAL, BoolArray, Float64Array, Int64Array
from octoreplay.result import Result, StoredMap, open_result

Point: TypeAlias = tuple[float, float, float]

UNKNOWN = "unknown"
"""What a cell is called that a map does not know."""

_LATEST = 1e9
"""No run is longer [s]."""


_PATHS = ("logs", "pose_file", "pose_times")
"""What of a robot's settings says where its data are; whether these are the same, their fingerprints tell."""


@dataclass(frozen=True)
class LabelChange:
    """So many cells that one result gives one label and the other another, 'free' and 'unknown' included."""

    label_a: str
    label_b: str
    num_cells: int


@dataclass(frozen=True)
class MapDifference:
    """One robot's maps in two results, or the two centralised ones; all counts are of finest cells.

    ``tick_a`` and ``seconds_a`` say which stored map was taken. ``num_relabelled`` of the cells known to both have
    different labels; ``label_changes`` are all pairs of different labels, the most frequent first.
    ``largest_difference`` is the largest |h_A - h_B| of any class, where an unknown cell counts as the prior, and
    ``largest_at`` the centre of the first cell that has it, None where it is 0. ``num_over_tolerance`` cells differ by
    more than the tolerance; ``num_differing`` are these and the cells that only one map knows, and ``lower`` and
    ``upper`` the corners of the box that holds them, None where there are none. Metres, in the team's frame.
    """

    robot_id: str
    tick_a: int
    tick_b: int
    seconds_a: float
    seconds_b: float
    num_cells_a_only: int
    num_cells_b_only: int
    num_cells_both: int
    num_relabelled: int
    label_changes: tuple[LabelChange, ...]
    largest_difference: float
    largest_at: Point | None
    num_over_tolerance: int
    num_differing: int
    lower: Point | None
    upper: Point | None


@dataclass(frozen=True)
class SettingDifference:
    """A setting that is not the same in both results; None stands for the default that follows from other settings.

    ``name`` is a parameter's name; what belongs to a robot, a class or a link has ``<it>.`` before it.
    """

    name: str
    value_a: Any
    value_b: Any


@dataclass(frozen=True)
class ResultComparison:
    """Two results ``a`` and ``b``, compared at ``at`` seconds after their starts (None: at their ends).

    ``is_same`` is True where no map differs by more than ``tolerance`` and neither result has a map that the other
    lacks; ``only_a`` and ``only_b`` name these. ``is_complete_a`` is False for what an interrupted run left, and
    ``same_inputs`` None where the fingerprints of the inputs were taken in different ways.
    """

    a: str
    b: str
    at: float | None
    tolerance: float
    is_same: bool
    maps: tuple[MapDifference, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    is_complete_a: bool
    is_complete_b: bool
    same_inputs: bool | None
    settings: tuple[SettingDifference, ...]


def compare_results(
    a: str | Path, b: str | Path, *, robot: str | None = None, at: float | None = None, tolerance: float = 0.0
) -> ResultComparison:
    """Compare the maps of two results, each robot's and the centralised one.

    ``robot``: only this robot's, or 'central'. ``at``: the last maps stored up to so many seconds after each run's
    start, None for the last of all. ``tolerance``: log-odds that differ by no more than this count as the same.

    Raises ConfigError for a tolerance or a time that is no number, and InputError for a result that cannot be read, a
    robot that neither has, and results of different resolutions or classes.
    """
    if not 0 <= tolerance < math.inf:
        raise ConfigError(f"tolerance: {tolerance:g} is not a number from 0 on")
    if at is not None and not abs(at) <= _LATEST:
        raise ConfigError(f"at: {at:g} is not a number of seconds up to {_LATEST:g}")
    with ExitStack() as stack:
        result_a, result_b = (stack.enter_context(open_result(path)) for path in (a, b))
        _check_comparable(result_a, result_b)
        names_a, names_b = (_chosen(result, robot) for result in (result_a, result_b))
        if not names_a and not names_b:
            raise InputError(
                f"{b}: neither it nor {a} has a map of robot '{robot}'; robots: {', '.join(result_a.robots)}"
            )
        maps = tuple(_map_difference(result_a, result_b, name, at, tolerance) for name in names_a if name in names_b)
        only_a = tuple(name for name in names_a if name not in names_b)
        only_b = tuple(name for name in names_b if name not in names_a)
        return ResultComparison(
            a=str(a), b=str(b), at=at, tolerance=tolerance,
            is_same=not (only_a or only_b or any(difference.num_differing for difference in maps)),
            maps=maps, only_a=only_a, only_b=only_b,
            is_complete_a=result_a.is_complete, is_complete_b=result_b.is_complete,
            same_inputs=_same_inputs(result_a, result_b),
            settings=tuple(_setting_differences(result_a.config, result_b.config)),
        )  # fmt: skip


def _map_difference(
    result_a: Result, result_b: Result, robot_id: str, at: float | None, tolerance: float
) -> MapDifference:
    """One map of both results, compared."""
    a, b = (result.map(robot_id, at_ns=None if at is None else result.time_ns(at)) for result in (result_a, result_b))
    spans_a, spans_b = a.octree.spans(), b.octree.spans()
    runs = common_runs(spans_a, spans_b)
    known_a, known_b = runs.leaves_a >= 0, runs.leaves_b >= 0
    labels_a, labels_b = _labels(a, spans_a, runs.leaves_a), _labels(b, spans_b, runs.leaves_b)
    differences = _differences(spans_a, spans_b, runs, a.prior - b.prior)
    is_over = differences > tolerance
    is_differing = is_over | (known_a != known_b)
    largest = int(np.argmax(differences)) if differences.size else -1
    has_largest = largest >= 0 and bool(differences[largest] > 0)
    corners = None
    if is_differing.any():
        low, high = bounding_box(runs.codes[is_differing], runs.num_cells[is_differing])
        corners = _point(low, a.resolution), _point(high + 1, a.resolution)

    def count(chosen: BoolArray) -> int:
        return int(runs.num_cells[chosen].sum())

    return MapDifference(
        robot_id=robot_id,
        tick_a=a.tick,
        tick_b=b.tick,
        seconds_a=result_a.seconds(a.stamp_ns),
        seconds_b=result_b.seconds(b.stamp_ns),
        num_cells_a_only=count(known_a & ~known_b),
        num_cells_b_only=count(~known_a & known_b),
        num_cells_both=count(known_a & known_b),
        num_relabelled=count(known_a & known_b & (labels_a != labels_b)),
        label_changes=_label_changes(result_a.class_table.names, labels_a, labels_b, runs.num_cells),
        largest_difference=float(differences[largest]) if has_largest else 0.0,
        largest_at=_point(codes_to_keys(runs.codes[[largest]])[0] + 0.5, a.resolution) if has_largest else None,
        num_over_tolerance=count(is_over),
        num_differing=count(is_differing),
        lower=corners[0] if corners else None,
        upper=corners[1] if corners else None,
    )


def _differences(a: LeafSpans, b: LeafSpans, runs: CommonRuns, prior_difference: float) -> Float64Array:
    """The largest |h_A - h_B| of any class in each run (S,); infinite where a value is no number."""
    largest = np.zeros(runs.codes.size)
    for values_a, values_b in zip(a.deviations.T, b.deviations.T, strict=True):
        # Deviations, because h = deviation + prior would round small differences away.
        difference = np.abs(_taken(values_a, runs.leaves_a) - _taken(values_b, runs.leaves_b) + prior_difference)
        np.maximum(largest, np.where(np.isnan(difference), np.inf, difference), out=largest)
    return largest


def _taken(values: Any, leaves: Int64Array) -> Float64Array:
    """A class's deviations (S,) in the leaves (S,); 0, the prior's, where there is no leaf."""
    taken = np.zeros(leaves.size)
    taken[leaves >= 0] = values[leaves[leaves >= 0]]
    return taken


def _labels(stored: StoredMap, spans: LeafSpans, leaves: Int64Array) -> Int64Array:
    """Each run's label (S,) in a map: class_id + 1, 1 for free, 0 for unknown."""
    of_leaf = best_labels(spans.deviations + np.float32(stored.prior)).astype(np.int64) + 1
    labels = np.zeros(leaves.size, np.int64)
    labels[leaves >= 0] = of_leaf[leaves[leaves >= 0]]
    return labels


def _label_changes(
    class_names: tuple[str, ...], labels_a: Int64Array, labels_b: Int64Array, num_cells: Int64Array
) -> tuple[LabelChange, ...]:
    """The pairs of different labels with their numbers of cells, the most frequent first, ties in order of class."""
    names = (UNKNOWN, "free", *class_names)
    changed = labels_a != labels_b
    pairs, index = np.unique(labels_a[changed] * len(names) + labels_b[changed], return_inverse=True)
    counts = np.zeros(pairs.size, np.int64)
    np.add.at(counts, index, num_cells[changed])
    order = np.argsort(-counts, kind="stable")
    return tuple(
        LabelChange(names[pair // len(names)], names[pair % len(names)], count)
        for pair, count in zip(pairs[order].tolist(), counts[order].tolist(), strict=True)
    )


def _point(keys: Any, resolution: float) -> Point:
    """A place in metres, rounded to what is more than a millionth of a cell."""
    decimals = 6 - math.floor(math.log10(resolution))
    x, y, z = (round(float(key) * resolution, decimals) for key in keys)
    return x, y, z


def _check_comparable(a: Result, b: Result) -> None:
    """Refuse results whose cells or classes are not the same."""
    resolutions = a.config.map.resolution, b.config.map.resolution
    if resolutions[0] != resolutions[1]:
        raise InputError(
            f"{b.path}: has the resolution {resolutions[1]} m, and {a.path} {resolutions[0]} m; run one of them"
            " again with the other's"
        )
    classes = itertools.zip_longest(a.class_table.names, b.class_table.names, fillvalue="(none)")
    for class_id, (name_a, name_b) in enumerate(classes, start=1):
        if name_a != name_b:
            raise InputError(
                f"{b.path}: has other classes than {a.path}: class {class_id} is '{name_b}', and there '{name_a}'; run"
                " one of them again with the other's"
            )


def _chosen(result: Result, robot: str | None) -> tuple[str, ...]:
    """The maps of a result to compare: of the robots, and the centralised one where it is stored."""
    central = (CENTRAL,) if result.stored_ticks(CENTRAL) else ()
    return tuple(name for name in (*result.robots, *central) if robot in (None, name))


def _same_inputs(a: Result, b: Result) -> bool | None:
    """Whether two results were made from the same files, by their fingerprints; None where these are of two kinds."""
    inputs_a, inputs_b = list(a.inputs.values()), list(b.inputs.values())
    if len(inputs_a) != len(inputs_b) or any(x[0] != y[0] for x, y in zip(inputs_a, inputs_b, strict=True)):
        return False
    if any(x[1] != y[1] for x, y in zip(inputs_a, inputs_b, strict=True)):
        return None
    return inputs_a == inputs_b


def _setting_differences(a: RunConfig, b: RunConfig) -> Iterator[SettingDifference]:
    """The settings that are not the same in two configurations, in their order."""
    shared = {robot.robot_id for robot in a.robots} & {robot.robot_id for robot in b.robots}
    values_a, values_b = dict(_settings(a, shared)), dict(_settings(b, shared))
    for name in dict.fromkeys((*values_a, *values_b)):
        if values_a.get(name) != values_b.get(name):
            yield SettingDifference(name, values_a.get(name), values_b.get(name))


def _settings(config: RunConfig, robots: Set[str]) -> Iterator[tuple[str, Any]]:
    """Every setting of a configuration by its name; of the robots' own, those of some ``robots``."""
    for parameter in PARAMETERS.values():
        yield parameter.name, getattr(getattr(config, parameter.section), parameter.name)
    for name in ("edges", "one_way", "schedule"):
        yield name, getattr(config.network, name)
    for sender, receiver, values in config.link_overrides:
        yield from ((f"{sender} -> {receiver}.{name}", value) for name, value in values)
    yield "merge_classes", config.merge_classes
    yield "ignore_hits", config.ignore_hits
    yield "robots", tuple(robot.robot_id for robot in config.robots)
    for robot in config.robots:
        for item in dataclasses.fields(robot):
            if robot.robot_id in robots and item.name not in (*_PATHS, "robot_id"):
                yield f"{robot.robot_id}.{item.name}", getattr(robot, item.name)
    for entry in config.classes.classes if config.classes else ():
        for name in ("color", "raw_labels", "raw_colors"):
            yield f"{entry.name}.{name}", getattr(entry, name)
    if config.classes is not None:
        yield "ignored_raw_labels", config.classes.ignored_raw_labels
        yield "ignored_raw_colors", config.classes.ignored_raw_colors
