"""Evaluations whose every number differs, for the tests of reporting."""

from __future__ import annotations

import math

from octoreplay.evaluate.records import EvaluatedTick, Evaluation, MapScores, TruthScores
from octoreplay.records import CENTRAL
from octoreplay.run_metrics import PairMetrics


def map_scores(robot_id: str, start: float, *, is_active: bool = True, has_truth: bool = True) -> MapScores:
    """Scores that grow by a thousandth from field to field."""
    values = [start + index / 1000 for index in range(11)]
    tree = math.nan if robot_id == "beta" else values[10] / 2
    truth = TruthScores((values[3] / 3, tree), *values[3:]) if has_truth else None
    return MapScores(robot_id, is_active, int(1e5 * start), values[0] + 1, values[1], values[2], truth)


def evaluation(
    num_ticks: int = 3, *, num_robots: int = 3, has_truth: bool = True, has_central: bool = True
) -> Evaluation:
    """Robots alpha (off at first), beta, ... and the centralised map over some ticks."""
    names = [*("alpha", "beta", "gamma")[:num_robots], *(f"robot_{index}" for index in range(4, num_robots + 1))]

    def maps(tick: int) -> tuple[MapScores, ...]:
        start = 0.1 + 0.5 * tick / num_ticks
        robots = [
            map_scores(name, start + index / 50, is_active=tick > 0 or index > 0, has_truth=has_truth)
            for index, name in enumerate(names)
        ]
        return (*robots, *([map_scores(CENTRAL, start + 0.3, has_truth=has_truth)] if has_central else []))

    pairs = (PairMetrics("alpha", "beta", 5000, 1000, 0.2, 0.01, 0.17, 0.13, 800, 0.125),)
    # The evidence is stored at the end only.
    ticks = tuple(
        EvaluatedTick(5 * t, 2.5 * t, 0.25 / (1 + t), maps(t), pairs if t == num_ticks - 1 else ())
        for t in range(num_ticks)
    )
    return Evaluation(
        "result.mcap", "world.npz" if has_truth else None, CENTRAL, "posterior", ("ground", "tree"), ticks
    )
