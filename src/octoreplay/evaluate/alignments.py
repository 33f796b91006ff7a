"""Alignment of a team compared with the true frames of its robots."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.verify import verify
from octoreplay.replay.alignment import Alignment
from octoreplay.transforms import inverse, pose_difference, transform_of

WRONG_SHIFT, WRONG_ANGLE = 1.0, 5.0
"""Errors of a pose [m], [degrees] from which it is wrong."""
_MIN_SHARED_CELLS = 20


class PairOutcome(NamedTuple):
    """Outcome of an alignment for two robots.

    Attributes
    ----------
    overlap : float
        Share of a map's obstacle cells that are in the space that the other robot knows under the true pose; the
        smaller one of the two maps.
    is_accepted : bool
        True where the alignment accepted its best pose.
    shift, angle : float
        Mean error of the best pose over the second robot's obstacles that the first one has too [m], over all its
        obstacles where these are fewer than 20 cells; and error of its rotation [degrees].
    """

    overlap: float
    is_accepted: bool
    shift: float
    angle: float

    @property
    def is_right(self) -> bool:
        """True where the best pose is off by less than 1 m and 5 degrees."""
        return self.shift < WRONG_SHIFT and self.angle < WRONG_ANGLE


def pair_outcomes(alignment: Alignment, true_frames: Mapping[str, Sequence[float]]) -> list[PairOutcome]:
    """Return the outcome of each pair of an alignment; ``true_frames`` is T_team_map (7 numbers) by robot_id.

    Raises KeyError for a robot without a true frame.
    """
    T_team_own = [
        transform_of(true_frames[robot_id]) @ T_map_own
        for robot_id, T_map_own in zip(alignment.robot_ids, alignment.T_map_own, strict=True)
    ]
    outcomes = []
    for pair in alignment.pairs:
        first, second = alignment.maps[pair.first], alignment.maps[pair.second]
        T_true = inverse(T_team_own[pair.first]) @ T_team_own[pair.second]
        shift = _mean_shift(first, second, pair.T_first_second, T_true)
        angle = math.degrees(pose_difference(pair.T_first_second, T_true)[1])
        overlap = verify(first, second, T_true, is_upright=alignment.dof == 4).overlap
        outcomes.append(PairOutcome(overlap, pair.is_accepted, shift, angle))
    return outcomes


def _mean_shift(first: OwnMap, second: OwnMap, T: Float64Array, T_true: Float64Array) -> float:
    """Mean distance [m] between obstacles of the second map under two poses; infinity without obstacles."""
    points = second.obstacles.points
    _, nearby = first.at(points @ T_true[:3, :3].T + T_true[:3, 3])
    shared = points[nearby != 0]
    points = shared if len(shared) >= _MIN_SHARED_CELLS else points
    if not len(points):
        return math.inf
    difference = T - T_true
    return float(np.linalg.norm(points @ difference[:3, :3].T + difference[:3, 3], axis=1).mean())
