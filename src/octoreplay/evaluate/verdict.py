"""Verdict on a run: whether the team agreed, whether the evidence supports its maps, and what it sent."""

from __future__ import annotations

import math
from dataclasses import dataclass

from octoreplay.evaluate.checks import CONSENSUS
from octoreplay.mapping.contradiction import contradicting_pairs
from octoreplay.run_metrics import RunSummary, ranked_pairs


@dataclass(frozen=True)
class RunVerdict:
    """Main figures of a run after its last tick; docs/metrics.md defines the metrics.

    Attributes
    ----------
    num_robots : int
        Number of robots.
    num_frames : int
        Number of groups of robots with a common frame.
    has_agreed : bool or None
        True where all robots are in one frame and ``label_disagreement`` is below 0.1 %; None where there is nothing to
        compare: one robot, or empty maps.
    label_disagreement : float
        Share of the known cells with different labels.
    agreement, agreement_occupied : float
        Share of all cells, and of occupied cells, with the label of all evidence, worst robot.
    is_consistent : bool or None
        False where the clear contradiction of a pair is so large that a run warns; None where no pair has enough cells.
    contradiction, clear_contradiction, label_contradiction : float
        Contradiction of evidence, each of its worst pair.
    worst_pair : tuple of str, or None
        Pair with the largest clear contradiction.
    sent_bytes_per_second : float
        Bytes that a robot sent per second of the logs, without settling, mean over the robots.
    total_sent_bytes : int
        Bytes that all robots sent, with settling.
    """

    num_robots: int
    num_frames: int
    has_agreed: bool | None
    label_disagreement: float
    agreement: float
    agreement_occupied: float
    is_consistent: bool | None
    contradiction: float
    clear_contradiction: float
    label_contradiction: float
    worst_pair: tuple[str, str] | None
    sent_bytes_per_second: float
    total_sent_bytes: int


def run_verdict(summary: RunSummary) -> RunVerdict:
    """Return the verdict on a run."""
    last, robots = summary.last, summary.last.counted_robots
    is_comparable = len(last.robots) > 1 and last.num_known_cells > 0
    ranked = ranked_pairs(last.pairs, "clear_contradiction")
    return RunVerdict(
        num_robots=len(last.robots),
        num_frames=last.num_components,
        has_agreed=last.num_components == 1 and last.label_disagreement < CONSENSUS if is_comparable else None,
        label_disagreement=last.label_disagreement,
        agreement=min((robot.agreement for robot in robots), default=math.nan),
        agreement_occupied=min((robot.agreement_occupied for robot in robots), default=math.nan),
        is_consistent=not contradicting_pairs(last.pairs) if ranked else None,
        contradiction=last.contradiction,
        clear_contradiction=last.clear_contradiction,
        label_contradiction=last.label_contradiction,
        worst_pair=(ranked[0].first, ranked[0].second) if ranked else None,
        sent_bytes_per_second=summary.sent_bytes_per_second,
        total_sent_bytes=summary.total_sent_bytes,
    )
