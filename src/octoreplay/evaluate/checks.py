"""Checks of a result against limits: each quantity with a limit, its worst value, and whether the limit holds.

The options of ``octoreplay check``, the names in ``check_result`` and the table in docs/cli.md are made from
``QUANTITIES``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from octoreplay.errors import ConfigError, suggestion
from octoreplay.records import CONVERGED, POSTERIOR, FilePath
from octoreplay.run_metrics import MIN_COMPARED_CELLS, RobotMetrics, RunSummary, TickMetrics, ranked_pairs

if TYPE_CHECKING:
    from octoreplay.evaluate.records import Evaluation
    from octoreplay.result import Result

CONSENSUS = 0.001
"""Label disagreement below which a team has reached consensus."""


@dataclass(frozen=True)
class CheckRow:
    """Result of one check.

    Attributes
    ----------
    name : str
        Name of the limit, such as 'max_packet_bytes', or 'complete' or 'settled', which have the values 1 and 0.
    limit, measured : float
        Limit, and the worst measured value.
    robot, link : str, optional
        Robot or link ('a -> b') of that value; None for a value of the whole team.
    seconds : float, optional
        Time of that value since the run's start; None for a value of the whole run.
    passed : bool
        True where the limit holds.
    detail : str
        Explanation where the numbers need one.
    pair : str, optional
        Pair of robots ('a and b') of that value.
    """

    name: str
    limit: float
    measured: float
    robot: str | None
    link: str | None
    seconds: float | None
    passed: bool
    detail: str = ""
    pair: str | None = None

    @property
    def is_flag(self) -> bool:
        """True for 'complete' and 'settled', which have no numeric limit."""
        return self.name in (_COMPLETE, _SETTLED)

    @property
    def is_upper(self) -> bool:
        """True where the measured value must be at most the limit."""
        return self.name.startswith("max_")


@dataclass(frozen=True)
class Measurement:
    """One value of a quantity, with its robot, link or pair of robots and its time where it has them."""

    value: float
    robot: str | None = None
    link: str | None = None
    seconds: float | None = None
    pair: str | None = None


@dataclass(frozen=True)
class _CheckedResult:
    """Result under check, and its evaluation against the truth if a limit needs one."""

    result: Result
    evaluation: Evaluation | None

    @property
    def summary(self) -> RunSummary:
        return self.result.summary

    @property
    def end(self) -> float:
        """Time of the last tick in seconds since the run's start."""
        return self.result.seconds(self.summary.last.stamp_ns)


@dataclass(frozen=True)
class Quantity:
    """Quantity of a result that limits can be set on.

    Attributes
    ----------
    name : str
        Name; the limits are called ``max_<name>`` and ``min_<name>``.
    bounds : tuple of str
        'max', 'min' or both.
    meaning : str
        Help text.
    measure : callable
        Yields all values in a result, of which the worst is checked.
    is_share : bool
        True for a number from 0 to 1.
    needs_truth : bool
        True where the values are scores against the truth.
    absent : str
        Reason where there is no value, or NaN.
    """

    name: str
    bounds: tuple[str, ...]
    meaning: str
    measure: Callable[[_CheckedResult], Iterable[Measurement]]
    is_share: bool = False
    needs_truth: bool = False
    absent: str = "no value to measure"

    @property
    def limits(self) -> tuple[str, ...]:
        """Names of the quantity's limits."""
        return tuple(f"{bound}_{self.name}" for bound in self.bounds)


def check_result(
    path: FilePath,
    limits: Mapping[str, float],
    *,
    settled: bool = False,
    truth: FilePath | None = None,
    map_kind: str = POSTERIOR,
) -> tuple[CheckRow, ...]:
    """Check a result against limits and return one row per check, failed ones first, in the order of ``LIMITS``.

    A value that cannot be measured is NaN and fails. The result of an interrupted run fails with a row of its own.

    Parameters
    ----------
    path : path
        Result file.
    limits : mapping of str to float
        Limits by name, such as {'max_label_disagreement': 0.001}; the names are those of ``LIMITS``.
    settled : bool
        True to check that the maps were at rest at the end.
    truth : path, optional
        True world (docs/simulation.md), which some limits need.
    map_kind : 'posterior' or 'mean'
        Form of the maps that limits with a truth judge (``StoredMap``).

    Raises
    ------
    ConfigError
        A limit or ``map_kind`` is unknown, a limit is out of range, no check is asked for, or the truth is missing or
        not needed.
    InputError
        The file is not a result or holds no tick.
    """
    from octoreplay.result import open_result

    _check_limits(limits, settled, truth is not None)
    with open_result(path) as result:
        checked = _CheckedResult(result, None if truth is None else _evaluation(result.path, Path(truth), map_kind))
        rows = [*_flags(checked, settled), *(_row(name, limits[name], checked) for name in LIMITS if name in limits)]
    return tuple(sorted(rows, key=lambda row: row.passed))


def ticks_to_consensus(metrics: Sequence[TickMetrics]) -> float:
    """Number of settling ticks until ``label_disagreement`` stays below ``CONSENSUS``; NaN if it does not.

    0 where it already is below in the last tick before settling.
    """
    first = max(sum(not tick.settling for tick in metrics) - 1, 0)
    open_ticks = [n for n, tick in enumerate(metrics[first:]) if not tick.label_disagreement < CONSENSUS]
    num_ticks = open_ticks[-1] + 1 if open_ticks else 0
    return float(num_ticks) if num_ticks < len(metrics) - first else math.nan


def _check_limits(limits: Mapping[str, float], settled: bool, has_truth: bool) -> None:
    """Refuse limits that cannot be checked."""
    if not limits and not settled:
        raise ConfigError("check: no limit given; give at least one, such as --max-label-disagreement 0.001")
    for name, limit in limits.items():
        if name not in LIMITS:
            raise ConfigError(f"unknown limit '{name}'{suggestion(name, LIMITS)}")
        if not 0 <= limit < math.inf:
            raise ConfigError(f"{name}: {limit:g} is not a finite number of at least 0")
        if LIMITS[name].is_share and limit > 1:
            raise ConfigError(f"{name}: {limit:g} is more than 1; give a share, such as 0.999 for 99.9 %")
    needing = [name for name in limits if LIMITS[name].needs_truth]
    if needing and not has_truth:
        raise ConfigError(f"{needing[0]}: needs the truth; give it with --truth")
    if has_truth and not needing:
        raise ConfigError("truth: no limit needs the truth; add one, such as --min-mean-iou 0.5, or leave --truth out")


def _evaluation(path: Path, truth: Path, map_kind: str) -> Evaluation:
    """Evaluation of a result's last maps against the truth."""
    from octoreplay.evaluate.evaluation import evaluate_result

    return evaluate_result(path, truth=truth, map_kind=map_kind, over_time=False)


_COMPLETE, _SETTLED = "complete", "settled"


def _flags(checked: _CheckedResult, settled: bool) -> Iterator[CheckRow]:
    """Yield the rows without a limit: an interrupted run, and maps at rest at the end."""
    reason = checked.summary.stop_reason
    if not checked.result.is_complete:
        detail = f"the run was interrupted ({reason}); replay the logs again"
        yield CheckRow(_COMPLETE, 1.0, 0.0, None, None, checked.end, passed=False, detail=detail)
    if settled:
        has_settled = reason == CONVERGED
        detail = "" if has_settled else f"stopped: {reason}"
        yield CheckRow(_SETTLED, 1.0, float(has_settled), None, None, checked.end, passed=has_settled, detail=detail)


def _row(name: str, limit: float, checked: _CheckedResult) -> CheckRow:
    """Compare one limit with the worst value of its quantity."""
    is_upper = name.startswith("max_")
    worst = _worst(LIMITS[name].measure(checked), is_upper)
    passed = worst.value <= limit if is_upper else worst.value >= limit
    detail = LIMITS[name].absent if math.isnan(worst.value) else ""
    return CheckRow(name, float(limit), worst.value, worst.robot, worst.link, worst.seconds, passed, detail, worst.pair)


def _worst(found: Iterable[Measurement], is_upper: bool) -> Measurement:
    """Worst value, the first of equal ones; NaN is worse than any number and stands for no value at all."""
    sign = -1.0 if is_upper else 1.0
    return min(
        found,
        key=lambda one: -math.inf if math.isnan(one.value) else sign * one.value,
        default=Measurement(math.nan),
    )


def _team_value(name: str) -> Callable[[_CheckedResult], Iterable[Measurement]]:
    """Return a measure of a field of TickMetrics in the last tick."""
    return lambda checked: [Measurement(getattr(checked.summary.last, name), seconds=checked.end)]


def _pair_values(name: str) -> Callable[[_CheckedResult], Iterable[Measurement]]:
    """Return a measure of a field of PairMetrics in the last tick, of the pairs with enough cells."""

    def measure(checked: _CheckedResult) -> Iterable[Measurement]:
        for pair in ranked_pairs(checked.summary.last.pairs, name):
            yield Measurement(getattr(pair, name), seconds=checked.end, pair=f"{pair.first} and {pair.second}")

    return measure


def _robot_values(name: str) -> Callable[[_CheckedResult], Iterable[Measurement]]:
    """Return a measure of a field of RobotMetrics in the last tick: of the active robots, or of all if none is."""

    def measure(checked: _CheckedResult) -> Iterable[Measurement]:
        robots = checked.summary.last.counted_robots
        return [Measurement(float(getattr(robot, name)), robot.robot_id, seconds=checked.end) for robot in robots]

    return measure


def _robot_values_of_all_ticks(name: str) -> Callable[[_CheckedResult], Iterable[Measurement]]:
    """Return a measure of a field of RobotMetrics in every tick."""

    def measure(checked: _CheckedResult) -> Iterable[Measurement]:
        for tick in checked.result.metrics:
            seconds = checked.result.seconds(tick.stamp_ns)
            for robot in tick.robots:
                yield Measurement(float(getattr(robot, name)), robot.robot_id, seconds=seconds)

    return measure


def _sent_bytes_per_second(checked: _CheckedResult) -> Iterable[Measurement]:
    """Bytes that each robot sent before settling, divided by the length of the logs."""
    duration = checked.summary.log_seconds
    sent: dict[str, int] = {}
    for robot in _robots_in_logs(checked.result.metrics):
        sent[robot.robot_id] = sent.get(robot.robot_id, 0) + robot.sent_bytes
    return [Measurement(num_bytes / duration if duration > 0 else math.nan, name) for name, num_bytes in sent.items()]


def _robots_in_logs(metrics: Iterable[TickMetrics]) -> Iterator[RobotMetrics]:
    """Yield the metrics of every robot in every tick before settling."""
    for tick in metrics:
        if not tick.settling:
            yield from tick.robots


def _delivered_share(checked: _CheckedResult) -> Iterable[Measurement]:
    """Share of delivered packets of each link that was given packets."""
    return [
        Measurement(link.num_delivered / link.num_sent, link=f"{link.sender} -> {link.receiver}")
        for link in checked.summary.links
        if link.num_sent
    ]


def _ticks_to_consensus(checked: _CheckedResult) -> Iterable[Measurement]:
    """Settling ticks until consensus."""
    return [Measurement(ticks_to_consensus(checked.result.metrics))]


def _frames_lost_share(checked: _CheckedResult) -> Iterable[Measurement]:
    """Share of each robot's frames that was not mapped."""
    for robot_id, counts in checked.summary.frame_counts.items():
        num_frames = counts.used + counts.skipped
        is_known = num_frames > 0 and not counts.truncated_files
        yield Measurement(counts.skipped / num_frames if is_known else math.nan, robot_id)


def _truth_scores(name: str) -> Callable[[_CheckedResult], Iterable[Measurement]]:
    """Return a measure of a score of each robot's last map against the truth."""

    def measure(checked: _CheckedResult) -> Iterable[Measurement]:
        if checked.evaluation is None:
            return []
        final = checked.evaluation.final
        return [Measurement(scores.score(name), scores.robot_id, seconds=final.seconds) for scores in final.robots]

    return measure


_NO_PAIR = f"no two robots share {MIN_COMPARED_CELLS} occupied cells, or the result is too old to hold their evidence"

QUANTITIES = (
    Quantity("label_disagreement", ("max",), "share of known cells with different labels at the end",
             _team_value("label_disagreement"), is_share=True),
    Quantity("total_distance", ("max",), "disagreement over the links at the end", _team_value("total_distance")),
    Quantity("total_distance_all", ("max",), "disagreement over all pairs of robots at the end",
             _team_value("total_distance_all")),
    Quantity("ticks_to_consensus", ("max",),
             "settling ticks until the share of known cells with different labels stays below 0.1 %",
             _ticks_to_consensus, absent="the labels did not reach consensus"),
    Quantity("agreement", ("min",), "share of known cells with the centralised map's label, worst robot at the end",
             _robot_values("agreement"), is_share=True),
    Quantity("agreement_occupied", ("min",), "the same over the cells that the centralised map calls occupied",
             _robot_values("agreement_occupied"), is_share=True),
    Quantity("contradiction", ("max",),
             f"share of the cells that one robot calls occupied and the other free, of the pair with the largest share"
             f" at the end; pairs with at least {MIN_COMPARED_CELLS} such cells",
             _pair_values("contradiction"), is_share=True, absent=_NO_PAIR),
    Quantity("clear_contradiction", ("max",),
             "the same over cells that the other robot calls firmly free, with no occupied cell beside them",
             _pair_values("clear_contradiction"), is_share=True, absent=_NO_PAIR),
    Quantity("label_contradiction", ("max",),
             "share with different labels of the cells that two robots call occupied, likewise",
             _pair_values("label_contradiction"), is_share=True, absent=_NO_PAIR),
    Quantity("entropy_bits", ("max",), "mean entropy of a known cell [bits], worst robot at the end",
             _robot_values("entropy_bits")),
    Quantity("num_leaves", ("max", "min"), "leaves of the largest (max) or the smallest (min) map at the end",
             _robot_values("num_leaves")),
    Quantity("memory_bytes", ("max",), "memory of a robot's evidence and map in any tick",
             _robot_values_of_all_ticks("memory_bytes")),
    Quantity("packet_bytes", ("max",), "size of a robot's packet in any tick, mean over its receivers",
             _robot_values_of_all_ticks("packet_bytes")),
    Quantity("sent_bytes_per_second", ("max",), "bytes per second over the length of the logs, robot that sends most",
             _sent_bytes_per_second),
    Quantity("delivered_share", ("min",), "share of delivered packets over the run, worst link",
             _delivered_share, is_share=True),
    Quantity("frames_lost_share", ("max",), "share of frames that could not be mapped, worst robot",
             _frames_lost_share, is_share=True, absent="there are no frames, or a log is truncated or damaged"),
    Quantity("mean_iou", ("min",), "mean intersection over union of the classes, worst robot; needs --truth",
             _truth_scores("mean_iou"), is_share=True, needs_truth=True),
    Quantity("coverage", ("min",), "share of the observed surface in the map, worst robot; needs --truth",
             _truth_scores("coverage"), is_share=True, needs_truth=True),
    Quantity("calibration_error", ("max",), "expected calibration error of the map shown, worst robot; needs --truth",
             _truth_scores("calibration_error"), is_share=True, needs_truth=True),
)  # fmt: skip
"""All quantities that limits can be set on."""

LIMITS = {name: quantity for quantity in QUANTITIES for name in quantity.limits}
"""Quantity of every limit, by the limit's name."""
