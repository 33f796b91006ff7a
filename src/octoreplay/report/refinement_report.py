"""Table and figure of the repair of drift."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from rich.table import Table

from octoreplay.evaluate.trajectories import TrajectoryErrors
from octoreplay.io.output_file import write_whole
from octoreplay.replay.refinement import Refinement
from octoreplay.report.figures import COLORS, GREY, legend_below, new_figure, picture_of, style
from octoreplay.report.tables import share, styled_table


def refinement_table(refinement: Refinement, errors: TrajectoryErrors | None) -> Table:
    """Return a table with one row per robot: size of the correction, test on held-back scans, errors, verdict."""
    table = styled_table("Repair of drift, before -> after")
    table.add_column("robot", no_wrap=True)
    table.add_column("correction [m]\nmean / largest", justify="right")
    table.add_column("contradiction on\nheld-back scans", justify="right")
    table.add_column("entropy\n[bits]", justify="right")
    if errors is not None:
        table.add_column("trajectory\nerror [m]", justify="right")
    table.add_column("poses", overflow="fold")
    for trajectory, score in zip(refinement.trajectories, refinement.scores, strict=True):
        shifts = trajectory.shifts
        cells = [
            trajectory.robot_id,
            f"{shifts.mean():.2f} / {shifts.max():.2f}" if shifts.size else "-",
            _change(share(score.before.share), share(score.after.share), is_known=score.before.num_cells > 0),
            _change(f"{score.entropy_before:.3f}", f"{score.entropy_after:.3f}"),
        ]
        if errors is not None:
            cells.append(_change(*(f"{error:.3f}" for error in errors.robots[trajectory.robot_id])))
        table.add_row(*cells, "corrected" if score.is_accepted else f"as recorded: {score.reason}")
    if errors is not None:
        team = _change(f"{errors.before:.3f}", f"{errors.after:.3f}")
        table.add_row("team", "", "", "", team, "", style="bold")
    return table


def refinement_content(refinement: Refinement, errors: TrajectoryErrors | None) -> dict[str, Any]:
    """Return a repair of drift for JSON: the robots' tests, the trajectory errors, and the numbers of submaps."""
    robots = [
        {
            "robot_id": trajectory.robot_id,
            "is_accepted": score.is_accepted,
            "reason": score.reason,
            "mean_shift": float(trajectory.shifts.mean()),
            "largest_shift": float(trajectory.shifts.max()),
            "contradiction_before": score.before.share,
            "contradiction_after": score.after.share,
            "entropy_before": score.entropy_before,
            "entropy_after": score.entropy_after,
        }
        for trajectory, score in zip(refinement.trajectories, refinement.scores, strict=True)
    ]
    numbers = {name: getattr(refinement, name) for name in ("num_submaps", "num_edges", "num_rejected")}
    return {"robots": robots, "trajectory_errors": errors, **numbers}


def _change(before: str, after: str, *, is_known: bool = True) -> str:
    """Text of a value before and after."""
    return f"{before} -> {after}" if is_known else "-"


def write_trajectory_figure(refinement: Refinement, path: Path) -> None:
    """Write a figure of the trajectories from above, recorded (dashed) and corrected, and of the corrections over time.

    Raises OutputError.
    """
    figure = new_figure(width=7.0, height=9.5)
    above, below = figure.subplots(2, 1, height_ratios=[3, 1])
    style(above, title="Trajectories in the team's frame", x_label="x [m]", y_label="y [m]")
    style(below, title="Distance between recorded and corrected position", x_label="log time [s]", y_label="[m]")
    stamps = [trajectory.stamps_ns[0] for trajectory in refinement.trajectories if trajectory.stamps_ns.size]
    for number, trajectory in enumerate(refinement.trajectories):
        color = COLORS[number % len(COLORS)]
        recorded, corrected = trajectory.recorded[:, :2, 3].T, trajectory.corrected[:, :2, 3].T
        above.plot(*recorded, color=color, linewidth=0.9, linestyle="--", alpha=0.7)
        above.plot(*corrected, color=color, linewidth=1.5, label=trajectory.robot_id)
        above.plot(*corrected[:, :1], color=color, marker="o", markersize=4)
        below.plot((trajectory.stamps_ns - min(stamps, default=0)) / 1e9, trajectory.shifts, color=color, linewidth=1.2)
    above.plot([], [], color=GREY, linewidth=0.9, linestyle="--", label="recorded")
    above.set_aspect("equal", adjustable="datalim")
    below.set_ylim(bottom=0)
    legend_below(figure, above, columns=min(6, math.ceil((len(refinement.trajectories) + 1) / 2) + 1))
    write_whole(path, picture_of(figure))
