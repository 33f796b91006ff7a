"""Anchored pull of rules gradient and natural: a robot keeps what it learned from robots that it no longer hears."""

from __future__ import annotations

from collections.abc import Iterable

from octoreplay.config.resolved import ResolvedRun
from octoreplay.mapping.consensus import Step, Update, team_step
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.replay.robots.robot import num_due


class Anchor:
    """Target of a robot's pull: its evidence log q_i, or log q_i + o while robots are absent.

    A robot is absent where it was heard at least once, and ``anchor_after`` of its due publications in a row did not
    arrive. Whenever a robot becomes absent or returns, o = h_i - log q_i is taken anew, so that the robot keeps its map
    and only new evidence moves it. Without absent robots the target is log q_i.

    Attributes
    ----------
    target : SemanticOctree or None
        log q_i + o; None for log q_i.
    absent : frozenset of int
        Absent robots.
    """

    def __init__(self, config: ResolvedRun) -> None:
        self.target: SemanticOctree | None = None
        self.absent: frozenset[int] = frozenset()
        self._config = config
        self._after = config.consensus.anchor_after
        self._heard: dict[int, int] = {}

    def advance(
        self,
        origins: Iterable[int],
        own: SemanticOctree,
        log_likelihood: SemanticOctree,
        last: SemanticOctree,
        tick: int,
    ) -> None:
        """Update the absent robots and the target for the iterations of a tick.

        ``origins`` are the robots whose maps arrived, ``own`` is the map h_i, ``log_likelihood`` log q_i, and ``last``
        its bricks that changed since the last iteration, as they were.
        """
        if not self._config.consensus.has_anchor:
            return
        self._heard.update(dict.fromkeys(origins, tick))
        absent = frozenset(
            index for index, heard in self._heard.items() if num_due(self._config, index, heard, tick) >= self._after
        )
        if absent != self.absent:
            self.absent = absent
            self.target = own.copy() if absent else None
        if self.target is not None:
            step = Step(self.target, (), (), log_likelihood, 0.0, last_evidence=last, since=tick)
            team_step([step], update=Update.ADD, revision=tick)
