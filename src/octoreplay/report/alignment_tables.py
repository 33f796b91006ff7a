"""Tables of an alignment: pairs of robots, and frames of the robots."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from octoreplay.records import Float64Array
from octoreplay.registration.pairs import PairAlignment
from octoreplay.replay.alignment import Alignment
from octoreplay.report.tables import share, styled_table, worst_pair
from octoreplay.run_metrics import PAIR_SHARES, PairMetrics

MAX_PAIRS = 30
"""Largest number of rows of the table of pairs."""

_NUMBERS = ("overlap", "cells", "q", "q_c", "q_g", "L")


def ranked(pairs: Sequence[PairAlignment]) -> list[PairAlignment]:
    """Return the accepted pairs before the refused ones, each with the largest L first."""
    return sorted(pairs, key=lambda pair: (not pair.is_accepted, -pair.verification.score))


def alignment_tables(alignment: Alignment) -> RenderableType:
    """Return the tables of an alignment: its pairs, and the frames of each component of two or more robots."""
    parts: list[RenderableType] = [pairs_table(alignment)]
    teams = [team for team in alignment.teams if len(team) > 1]
    for number, team in enumerate(teams, start=1):
        frames = (FrameRow(frame.robot_id, frame.T_team_map, frame.sigma, frame.origin) for frame in team)
        parts += ["", frames_table(frames, f"Frames of component {number}" if len(teams) > 1 else "Frames")]
    return Group(*parts)


def contradiction_table(pairs_by_frames: Mapping[str, Sequence[PairMetrics]]) -> Table:
    """Return a table of the contradiction of evidence, with one row for each choice of frames."""
    table = styled_table("Contradiction of evidence, worst pair")
    for name in ("frames", "contradiction", "clear contradiction", "label contradiction"):
        table.add_column(name, overflow="fold")
    for frames, pairs in pairs_by_frames.items():
        table.add_row(frames, *(worst_pair(pairs, name) for name in PAIR_SHARES))
    return table


def pair_numbers(pair: PairAlignment, dof: int) -> dict[str, str]:
    """Return the numbers behind the verdict on a pair as texts, by name; '-' where a number does not count."""
    agreement, is_upright = pair.verification, dof == 4
    texts = (
        share(agreement.overlap),
        f"{agreement.obstacles.total:,}",
        f"{agreement.obstacles.share_same:.3f}",
        f"{agreement.obstacles.share_contra:.3f}",
        f"{agreement.ground.share_same:.3f}" if is_upright else "-",
        f"{agreement.score:.0f}" if is_upright else "-",
    )
    return dict(zip(_NUMBERS, texts, strict=True))


def pairs_table(alignment: Alignment) -> RenderableType:
    """Return a table of the pairs with the numbers behind each verdict (docs/frames.md)."""
    table = styled_table("Pairs")
    table.add_column("robots", overflow="fold")
    for name in _NUMBERS:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("verdict", overflow="fold")
    rows = ranked(alignment.pairs)
    for pair in rows[:MAX_PAIRS]:
        table.add_row(
            f"{alignment.robot_ids[pair.first]}, {alignment.robot_ids[pair.second]}",
            *pair_numbers(pair, alignment.dof).values(),
            Text("accepted", style="green") if pair.is_accepted else f"refused: {pair.refusal}",
        )
    if len(rows) <= MAX_PAIRS:
        return table
    hidden = rows[MAX_PAIRS:]
    accepted = sum(pair.is_accepted for pair in hidden)
    return Group(table, f"and {len(hidden)} more pairs, of which {accepted} are accepted; --csv writes all")


class FrameRow(NamedTuple):
    """Row of a table of frames: T_team_map (4, 4), its ``RobotFrame.sigma``, and a phrase on its origin."""

    robot_id: str
    T_team_map: Float64Array
    sigma: Sequence[float] | None
    origin: str


def frames_table(frames: Iterable[FrameRow], title: str) -> Table:
    """Return a table of the robots' frames: position [m] and angles [degrees], each with its standard deviation."""
    table = styled_table(title)
    table.add_column("robot", no_wrap=True)
    for name in ("x [m]", "y [m]", "z [m]", "yaw [\u00b0]", "tilt [\u00b0]", "\u00b1 xyz [m]", "\u00b1 yaw [\u00b0]"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("from", overflow="fold")
    for robot_id, T, sigma, origin in frames:
        # Adding 0 turns -0 into 0.
        yaw = round(math.degrees(math.atan2(T[1, 0], T[0, 0])), 1) + 0.0
        tilt = math.degrees(math.acos(min(1.0, max(-1.0, float(T[2, 2])))))
        spread = ("-", "-") if sigma is None else (f"{math.hypot(*sigma[:3]):.2f}", f"{math.degrees(sigma[5]):.2f}")
        table.add_row(
            robot_id,
            *(f"{round(float(value), 2) + 0.0:.2f}" for value in T[:3, 3]),
            f"{yaw:.1f}",
            f"{tilt:.1f}",
            *spread,
            origin,
        )
    return table
