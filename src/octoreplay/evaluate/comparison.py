"""Comparison of two results: whether their maps are equal, where and by how much they differ.

All numbers count finest cells, independent of the leaves that store them (docs/cli.md).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.run import RunConfig
from octoreplay.data_table import Table
from octoreplay.errors import ConfigError, InputError
from octoreplay.evaluate.morton_intervals import MortonIntervals, bounding_box, common_intervals
from octoreplay.log_odds import best_labels
from octoreplay.mapping.octree import LeafSpans, codes_to_keys
from octoreplay.records import CENTRAL, BoolArray, FilePath, Float64Array, Int64Array
from octoreplay.result import Result, open_result
from octoreplay.stored_map import StoredMap

Point: TypeAlias = tuple[float, float, float]

UNKNOWN = "unknown"
"""Label of a cell that a map does not know."""

_LATEST = 1e9
"""Upper limit of the length of a run [s]."""

_PATHS = ("logs", "pose_file", "pose_times")
"""A robot's settings that are paths; the inputs are compared by their fingerprints instead."""


@dataclass(frozen=True)
class LabelChange:
    """Number of cells with one label in A and another in B; labels include 'free' and 'unknown'."""

    label_a: str
    label_b: str
    num_cells: int


@dataclass(frozen=True)
class MapDifference:
    """Difference of one robot's maps, or of the centralised maps, in two results.

    Counts are of finest cells; points are in metres, in the team's frame.

    Attributes
    ----------
    robot_id : str
        Robot of the maps, or 'central'.
    tick_a, tick_b : int
        Ticks of the compared maps.
    seconds_a, seconds_b : float
        Times of the compared maps since the start of their runs.
    num_cells_a_only, num_cells_b_only, num_cells_both : int
        Cells that only A, only B and both maps know.
    num_relabelled : int
        Cells that both maps know and label differently.
    label_changes : tuple of LabelChange
        Pairs of different labels, the most frequent first.
    largest_difference : float
        Largest |h_A - h_B| of any class; an unknown cell counts as the prior.
    largest_at : tuple of float, optional
        Centre of the first cell with the largest difference, None where that is 0.
    num_over_tolerance : int
        Cells that differ by more than the tolerance.
    num_differing : int
        The same cells and those that only one map knows.
    lower, upper : tuple of float, optional
        Corners of the box around the differing cells, None without any.
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
    """Setting with different values in two results; None is a default that follows from other settings.

    ``name`` is the name of a parameter. Settings of one robot, class or link have its name and a dot in front.
    """

    name: str
    value_a: Any
    value_b: Any


@dataclass(frozen=True)
class ResultComparison:
    """Comparison of two results.

    Attributes
    ----------
    a, b : str
        Paths of the results.
    at : float, optional
        Time since the start of each run in seconds, None for the end.
    tolerance : float
        Largest difference of log-odds that counts as equal.
    is_same : bool
        True where no map differs by more than ``tolerance`` and both results have maps of the same robots.
    maps : tuple of MapDifference
        Maps that both results have.
    only_a, only_b : tuple of str
        Robots with a map in only one of the results.
    is_complete_a, is_complete_b : bool
        False for the result of an interrupted run.
    same_inputs : bool, optional
        True where both were made from the same files, None where their fingerprints have different methods.
    settings : tuple of SettingDifference
        Settings with different values.
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

    def as_table(self) -> Table:
        """Return the numbers of ``maps`` as a table, one row per robot."""
        return Table.from_records(MapDifference, self.maps)


def compare_results(
    a: FilePath, b: FilePath, *, robot: str | None = None, at: float | None = None, tolerance: float = 0.0
) -> ResultComparison:
    """Compare the robots' maps and the centralised maps of two results.

    Parameters
    ----------
    a, b : path
        Result files.
    robot : str, optional
        Compare the maps of this robot only, or of 'central'.
    at : float, optional
        Compare the last maps stored up to this time since the start of each run, in seconds; None for the end.
    tolerance : float
        Largest difference of log-odds that counts as equal.

    Raises
    ------
    ConfigError
        ``tolerance`` is negative or not finite, or ``at`` is not finite or above 1e9.
    InputError
        A result cannot be read, neither has maps of ``robot``, or their resolutions or classes differ.
    """
    if not 0 <= tolerance < math.inf:
        raise ConfigError(f"tolerance: {tolerance:g} is not a finite number of at least 0")
    if at is not None and not abs(at) <= _LATEST:
        raise ConfigError(f"at: {at:g} is not a number of seconds up to {_LATEST:g}")
    a, b = Path(a), Path(b)
    with ExitStack() as stack:
        result_a, result_b = (stack.enter_context(open_result(path)) for path in (a, b))
        _check_comparable(result_a, result_b)
        names_a, names_b = (_map_names(result, robot) for result in (result_a, result_b))
        if not names_a and not names_b:
            raise InputError(f"{a}, {b}: neither has a map of robot '{robot}'; robots: {', '.join(result_a.robots)}")
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
    """Compare one robot's maps, in tiles where both results have tiles."""
    parts = (
        _part_difference(result_a, result_b, robot_id, at, tolerance, box) for box in result_a.boxes(beside=[result_b])
    )
    places = {name: place for place, name in enumerate((UNKNOWN, "free", *result_a.class_table.names))}
    return functools.reduce(functools.partial(_joined, places), parts)


def _joined(places: Mapping[str, int], first: MapDifference, second: MapDifference) -> MapDifference:
    """Difference of two parts of the same maps; ``places`` order the labels."""
    counts = {
        item.name: getattr(first, item.name) + getattr(second, item.name)
        for item in dataclasses.fields(MapDifference)
        if item.name.startswith("num_")
    }
    changes = Counter({(change.label_a, change.label_b): change.num_cells for change in first.label_changes})
    changes.update({(change.label_a, change.label_b): change.num_cells for change in second.label_changes})
    ordered = sorted(changes.items(), key=lambda item: (-item[1], *(places[label] for label in item[0])))
    largest = second if second.largest_difference > first.largest_difference else first
    corners = [(part.lower, part.upper) for part in (first, second) if part.lower is not None]
    return dataclasses.replace(
        first, **counts, label_changes=tuple(LabelChange(*labels, count) for labels, count in ordered),
        largest_difference=largest.largest_difference, largest_at=largest.largest_at,
        lower=_extreme(min, [lower for lower, _ in corners]), upper=_extreme(max, [upper for _, upper in corners]),
    )  # fmt: skip


def _extreme(choose: Callable[[Iterable[float]], float], points: Sequence[Point | None]) -> Point | None:
    """Least or largest coordinates of points; None without points."""
    if not points:
        return None
    x, y, z = (choose(values) for values in zip(*(point for point in points if point is not None), strict=True))
    return x, y, z


def _part_difference(
    result_a: Result, result_b: Result, robot_id: str, at: float | None, tolerance: float, bounds: Sequence[float]
) -> MapDifference:
    """Compare one robot's maps in a box."""
    a, b = (
        result.map(robot_id, at_ns=None if at is None else result.time_ns(at), bounds=bounds)
        for result in (result_a, result_b)
    )
    spans_a, spans_b = a.octree.spans(), b.octree.spans()
    intervals = common_intervals(spans_a, spans_b)
    known_a, known_b = intervals.leaves_a >= 0, intervals.leaves_b >= 0
    labels_a, labels_b = _labels(a, spans_a, intervals.leaves_a), _labels(b, spans_b, intervals.leaves_b)
    differences = _differences(spans_a, spans_b, intervals, a.prior - b.prior)
    is_over = differences > tolerance
    is_differing = is_over | (known_a != known_b)
    largest = int(np.argmax(differences)) if differences.size else -1
    has_largest = largest >= 0 and bool(differences[largest] > 0)
    corners = None
    if is_differing.any():
        low, high = bounding_box(intervals.codes[is_differing], intervals.num_cells[is_differing])
        corners = _point(low, a.resolution), _point(high + 1, a.resolution)

    def count(chosen: BoolArray) -> int:
        return int(intervals.num_cells[chosen].sum())

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
        label_changes=_label_changes(result_a.class_table.names, labels_a, labels_b, intervals.num_cells),
        largest_difference=float(differences[largest]) if has_largest else 0.0,
        largest_at=_point(codes_to_keys(intervals.codes[[largest]])[0] + 0.5, a.resolution) if has_largest else None,
        num_over_tolerance=count(is_over),
        num_differing=count(is_differing),
        lower=corners[0] if corners else None,
        upper=corners[1] if corners else None,
    )


def _differences(a: LeafSpans, b: LeafSpans, intervals: MortonIntervals, prior_difference: float) -> Float64Array:
    """Largest |h_A - h_B| of any class in each interval (S,); infinite where a value is NaN."""
    largest = np.zeros(intervals.codes.size)
    for values_a, values_b in zip(a.deviations.T, b.deviations.T, strict=True):
        # Deviations from the prior are compared, since float32 sums with the prior would lose small differences.
        difference = np.abs(
            _values_in(values_a, intervals.leaves_a) - _values_in(values_b, intervals.leaves_b) + prior_difference
        )
        np.maximum(largest, np.where(np.isnan(difference), np.inf, difference), out=largest)
    return largest


def _values_in(values: Any, leaves: Int64Array) -> Float64Array:
    """Deviations (S,) of a class in the leaves (S,); 0, that of the prior, without a leaf."""
    taken = np.zeros(leaves.size)
    taken[leaves >= 0] = values[leaves[leaves >= 0]]
    return taken


def _labels(stored: StoredMap, spans: LeafSpans, leaves: Int64Array) -> Int64Array:
    """Label of each interval (S,) in a map: class_id + 1, so 1 for free, and 0 for unknown."""
    of_leaf = best_labels(spans.deviations + np.float32(stored.prior)).astype(np.int64) + 1
    labels = np.zeros(leaves.size, np.int64)
    labels[leaves >= 0] = of_leaf[leaves[leaves >= 0]]
    return labels


def _label_changes(
    class_names: tuple[str, ...], labels_a: Int64Array, labels_b: Int64Array, num_cells: Int64Array
) -> tuple[LabelChange, ...]:
    """Pairs of different labels, the most frequent first, ties in the order of the classes."""
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
    """Point in metres from keys, rounded to about a millionth of a cell."""
    decimals = 6 - math.floor(math.log10(resolution))
    x, y, z = (round(float(key) * resolution, decimals) for key in keys)
    return x, y, z


def _check_comparable(a: Result, b: Result) -> None:
    """Refuse results with different resolutions or classes."""
    resolutions = a.config.map.resolution, b.config.map.resolution
    if resolutions[0] != resolutions[1]:
        raise InputError(
            f"{b.path}: the resolution is {resolutions[1]} m, and {resolutions[0]} m in {a.path}; replay one of them"
            " again with the other's resolution"
        )
    classes = itertools.zip_longest(a.class_table.names, b.class_table.names, fillvalue="(none)")
    for class_id, (name_a, name_b) in enumerate(classes, start=1):
        if name_a != name_b:
            raise InputError(
                f"{b.path}: class {class_id} is '{name_b}', and '{name_a}' in {a.path}; replay one of them again with"
                " the other's classes"
            )


def _map_names(result: Result, robot: str | None) -> tuple[str, ...]:
    """Names of a result's maps to compare: of the robots, and the centralised one if it is stored."""
    central = (CENTRAL,) if result.stored_ticks(CENTRAL) else ()
    return tuple(name for name in (*result.robots, *central) if robot in (None, name))


def _same_inputs(a: Result, b: Result) -> bool | None:
    """True where the inputs of two results have equal sizes and fingerprints; None for different methods."""
    inputs_a, inputs_b = list(a.inputs.values()), list(b.inputs.values())
    if len(inputs_a) != len(inputs_b) or any(x[0] != y[0] for x, y in zip(inputs_a, inputs_b, strict=True)):
        return False
    if any(x[1] != y[1] for x, y in zip(inputs_a, inputs_b, strict=True)):
        return None
    return inputs_a == inputs_b


def _setting_differences(a: RunConfig, b: RunConfig) -> Iterator[SettingDifference]:
    """Yield the settings that differ between two configurations, in their order."""
    shared = {robot.robot_id for robot in a.robots} & {robot.robot_id for robot in b.robots}
    values_a, values_b = dict(_settings(a, shared)), dict(_settings(b, shared))
    for name in dict.fromkeys((*values_a, *values_b)):
        if values_a.get(name) != values_b.get(name):
            yield SettingDifference(name, values_a.get(name), values_b.get(name))


def _settings(config: RunConfig, robots: Set[str]) -> Iterator[tuple[str, Any]]:
    """Yield every setting of a configuration by name; settings of a robot only for ``robots``."""
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
