"""Limits on what a result came to: each quantity that can be limited, where it is worst, and whether it holds.

``QUANTITIES`` is the one list of them: the options of ``octoreplay check``, the names in ``check_result`` and the table
in docs/cli.md follow from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from octoreplay.errors import ConfigError, suggestion
from octoreplay.records import CONVERGED, RobotMetrics, RunSummary, TickMetrics

if TYPE_CHECKING:
    from octoreplay.evaluate.records import Evaluation
    from octoreplay.result import Result

CONSENSUS = 0.001
"""A team agrees when fewer than this share of the known cells has different labels."""


@dataclass(frozen=True)
class CheckRow:
    """One limit and what was measured.

    ``name`` is the limit's name ('max_packet_bytes'), or 'complete' or 'settled', which are 1 or 0. ``robot`` and
    ``link`` ('a -> b') say whose value it is, the worst of all, and ``seconds`` since the run's start when; None where
    it belongs to the whole team or the whole run. ``detail`` is a sentence where numbers do not say it.
    """

    name: str
    limit: float
    measured: float
    robot: str | None
    link: str | None
    seconds: float | None
    passed: bool
    detail: str = ""

    @property
    def is_flag(self) -> bool:
        """True for what either is so or not."""
        return self.name in (_COMPLETE, _SETTLED)

    @property
    def is_upper(self) -> bool:
        """True where the measured value must be at most the limit."""
        return self.name.startswith("max_")


@dataclass(frozen=True)
class Measurement:
    """One value of a quantity, and whose and when it was."""

    value: float
    robot: str | None = None
    link: str | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class _Subject:
    """What is measured: a result, and its maps against the truth where a limit needs that."""

    result: Result
    evaluation: Evaluation | None

    @property
    def summary(self) -> RunSummary:
        return self.result.summary

    @property
    def end(self) -> float:
        """The last tick, in seconds since the run's start."""
        return self.result.seconds(self.summary.last.stamp_ns)


@dataclass(frozen=True)
class Quantity:
    """Something that can be limited: by ``max_<name>``, ``min_<name>`` or both (``bounds``).

    ``measure`` gives all its values, of which the worst counts; ``absent`` says why there is none, or NaN. A share is a
    number from 0 to 1.
    """

    name: str
    bounds: tuple[str, ...]
    meaning: str
    measure: Callable[[_Subject], Iterable[Measurement]]
    is_share: bool = False
    needs_truth: bool = False
    absent: str = "there is nothing to measure"

    @property
    def limits(self) -> tuple[str, ...]:
        """The names of its limits."""
        return tuple(f"{bound}_{self.name}" for bound in self.bounds)


def check_result(
    path: str | Path, limits: Mapping[str, float], *, settled: bool = False, truth: str | Path | None = None
) -> tuple[CheckRow, ...]:
    """Hold a result against limits such as {'max_label_disagreement': 0.001}; failed rows first, else as in the list.

    The names are those of ``LIMITS``. ``settled``: the maps must have come to rest at the end. ``truth``: the true
    world (docs/simulation.md), which some limits need. A value that cannot be measured is NaN and fails, and so does
    the result of an interrupted run, with a row that says so.

    Raises ConfigError for a limit that is unknown or out of range, no limit at all, and limits that need the truth
    without it; InputError for a file that is no result or holds no tick.
    """
    from octoreplay.result import open_result

    _check_limits(limits, settled, truth is not None)
    with open_result(path) as result:
        subject = _Subject(result, None if truth is None else _evaluation(result.path, Path(truth)))
        rows = [*_flags(subject, settled), *(_row(name, limits[name], subject) for name in LIMITS if name in limits)]
    return tuple(sorted(rows, key=lambda row: row.passed))


def ticks_to_consensus(metrics: Sequence[TickMetrics]) -> float:
    """Settling ticks until ``label_disagreement`` is below ``CONSENSUS`` and stays there; NaN if it does not.

    0 where it is so in the last tick before settling already.
    """
    first = max(sum(not tick.settling for tick in metrics) - 1, 0)
    open_ticks = [n for n, tick in enumerate(metrics[first:]) if not tick.label_disagreement < CONSENSUS]
    num_ticks = open_ticks[-1] + 1 if open_ticks else 0
    return float(num_ticks) if num_ticks < len(metrics) - first else math.nan


def _check_limits(limits: Mapping[str, float], settled: bool, has_truth: bool) -> None:
    """Refuse limits that cannot be checked."""
    if not limits and not settled:
        raise ConfigError("check: no limit is given; give at least one, such as --max-label-disagreement 0.001")
    for name, limit in limits.items():
        if name not in LIMITS:
            raise ConfigError(f"limit '{name}' is not known{suggestion(name, LIMITS)}")
        if not 0 <= limit < math.inf:
            raise ConfigError(f"{name}: {limit:g} is not a number from 0 on")
        if LIMITS[name].is_share and limit > 1:
            raise ConfigError(f"{name}: {limit:g} is more than 1; it is a share, 0.999 where 99.9 % are meant")
    needing = [name for name in limits if LIMITS[name].needs_truth]
    if needing and not has_truth:
        raise ConfigError(f"{needing[0]}: needs the true world; give it with --truth")
    if has_truth and not needing:
        raise ConfigError("truth: no limit needs it; add one, such as --min-mean-iou 0.5, or leave it out")


def _evaluation(path: Path, truth: Path) -> Evaluation:
    """The last maps of a result against the truth."""
    from octoreplay.evaluate.evaluation import evaluate_result

    return evaluate_result(path, truth=truth, over_time=False)


_COMPLETE, _SETTLED = "complete", "settled"


def _flags(subject: _Subject, settled: bool) -> Iterator[CheckRow]:
    """The rows that no limit is for: an interrupted run, and maps that must have come to rest."""
    reason = subject.summary.stop_reason
    if not subject.result.is_complete:
        detail = f"the run was interrupted ({reason}); run the logs again"
        yield CheckRow(_COMPLETE, 1.0, 0.0, None, None, subject.end, passed=False, detail=detail)
    if settled:
        has_settled = reason == CONVERGED
        detail = "" if has_settled else f"stopped: {reason}"
        yield CheckRow(_SETTLED, 1.0, float(has_settled), None, None, subject.end, passed=has_settled, detail=detail)


def _row(name: str, limit: float, subject: _Subject) -> CheckRow:
    """One limit, held against the worst value of its quantity."""
    is_upper = name.startswith("max_")
    worst = _worst(LIMITS[name].measure(subject), is_upper)
    passed = worst.value <= limit if is_upper else worst.value >= limit
    detail = LIMITS[name].absent if math.isnan(worst.value) else ""
    return CheckRow(name, float(limit), worst.value, worst.robot, worst.link, worst.seconds, passed, detail)


def _worst(found: Iterable[Measurement], is_upper: bool) -> Measurement:
    """The largest or the smallest value, the first of equals; NaN is worse than any, and what nothing comes to."""
    sign = -1.0 if is_upper else 1.0
    return min(
        found,
        key=lambda one: -math.inf if math.isnan(one.value) else sign * one.value,
        default=Measurement(math.nan),
    )


def _of_team(name: str) -> Callable[[_Subject], Iterable[Measurement]]:
    """A number of the whole team in the last tick."""
    return lambda subject: [Measurement(getattr(subject.summary.last, name), seconds=subject.end)]


def _of_robots(name: str) -> Callable[[_Subject], Iterable[Measurement]]:
    """A number of each robot in the last tick, as the table of results has it: of the active ones, else of all."""

    def measure(subject: _Subject) -> Iterable[Measurement]:
        robots = subject.summary.last.counted_robots
        return [Measurement(float(getattr(robot, name)), robot.robot_id, seconds=subject.end) for robot in robots]

    return measure


def _of_any_tick(name: str) -> Callable[[_Subject], Iterable[Measurement]]:
    """A number of each robot in every tick."""

    def measure(subject: _Subject) -> Iterable[Measurement]:
        for tick in subject.result.metrics:
            seconds = subject.result.seconds(tick.stamp_ns)
            for robot in tick.robots:
                yield Measurement(float(getattr(robot, name)), robot.robot_id, seconds=seconds)

    return measure


def _sent_bytes_per_second(subject: _Subject) -> Iterable[Measurement]:
    """What each robot sent before settling, over the time of the logs."""
    duration = subject.summary.log_seconds
    sent: dict[str, int] = {}
    for robot in _robots_in_logs(subject.result.metrics):
        sent[robot.robot_id] = sent.get(robot.robot_id, 0) + robot.sent_bytes
    return [Measurement(num_bytes / duration if duration > 0 else math.nan, name) for name, num_bytes in sent.items()]


def _robots_in_logs(metrics: Iterable[TickMetrics]) -> Iterator[RobotMetrics]:
    """Every robot in every tick before settling."""
    for tick in metrics:
        if not tick.settling:
            yield from tick.robots


def _delivered_share(subject: _Subject) -> Iterable[Measurement]:
    """Of each link that was given packets, the share that arrived."""
    return [
        Measurement(link.num_delivered / link.num_sent, link=f"{link.sender} -> {link.receiver}")
        for link in subject.summary.links
        if link.num_sent
    ]


def _ticks_to_consensus(subject: _Subject) -> Iterable[Measurement]:
    return [Measurement(ticks_to_consensus(subject.result.metrics))]


def _frames_lost_share(subject: _Subject) -> Iterable[Measurement]:
    """Of each robot's frames, the share that was not mapped."""
    for robot_id, counts in subject.summary.frame_counts.items():
        num_frames = counts.used + counts.skipped
        is_known = num_frames > 0 and not counts.truncated_files
        yield Measurement(counts.skipped / num_frames if is_known else math.nan, robot_id)


def _of_truth(name: str) -> Callable[[_Subject], Iterable[Measurement]]:
    """A score of each robot's last map against the truth."""

    def measure(subject: _Subject) -> Iterable[Measurement]:
        if subject.evaluation is None:
            return []
        final = subject.evaluation.final
        return [Measurement(getattr(scores, name), scores.robot_id, seconds=final.seconds) for scores in final.robots]

    return measure


QUANTITIES = (
    Quantity("label_disagreement", ("max",), "share of known cells that robots label differently, at the end",
             _of_team("label_disagreement"), is_share=True),
    Quantity("total_distance", ("max",), "disagreement over the links, at the end", _of_team("total_distance")),
    Quantity("total_distance_all", ("max",), "disagreement over all pairs of robots, at the end",
             _of_team("total_distance_all")),
    Quantity("ticks_to_consensus", ("max",),
             "settling ticks until robots label fewer than 0.1 % of the known cells differently, and it stays so",
             _ticks_to_consensus, absent="the labels never came to agree"),
    Quantity("agreement", ("min",), "share of known cells labelled as all evidence says, of the worst robot at the end",
             _of_robots("agreement"), is_share=True),
    Quantity("agreement_occupied", ("min",), "the same, of the cells that all evidence calls occupied",
             _of_robots("agreement_occupied"), is_share=True),
    Quantity("entropy_bits", ("max",), "mean entropy of a known cell [bits], of the least certain robot at the end",
             _of_robots("entropy_bits")),
    Quantity("num_leaves", ("max", "min"), "leaves of the largest (max) or smallest (min) map at the end",
             _of_robots("num_leaves")),
    Quantity("memory_bytes", ("max",), "memory of a robot's evidence and map, the most of any tick",
             _of_any_tick("memory_bytes")),
    Quantity("packet_bytes", ("max",), "a packet of any robot in any tick, in the mean over its receivers",
             _of_any_tick("packet_bytes")),
    Quantity("sent_bytes_per_second", ("max",), "mean over the time of the logs, of the robot that sends the most",
             _sent_bytes_per_second),
    Quantity("delivered_share", ("min",), "share of the packets that arrived over the run, on the worst link",
             _delivered_share, is_share=True),
    Quantity("frames_lost_share", ("max",), "share of a robot's frames that could not be mapped, of the worst robot",
             _frames_lost_share, is_share=True, absent="there are no frames, or a log was cut or damaged"),
    Quantity("mean_iou", ("min",), "mean intersection over union of the classes, of the worst robot; needs --truth",
             _of_truth("mean_iou"), is_share=True, needs_truth=True),
    Quantity("coverage", ("min",), "share of the observed surface that the worst robot's map has; needs --truth",
             _of_truth("coverage"), is_share=True, needs_truth=True),
    Quantity("calibration_error", ("max",), "expected calibration error of the worst robot; needs --truth",
             _of_truth("calibration_error"), is_share=True, needs_truth=True),
    Quantity("team_calibration_error", ("max",), "the same of the team posterior h_0 + N (h - h_0); needs --truth",
             _of_truth("team_calibration_error"), is_share=True, needs_truth=True),
)  # fmt: skip
"""All that can be limited."""

LIMITS = {name: quantity for quantity in QUANTITIES for name in quantity.limits}
"""The quantity of every limit, by the limit's name."""
