"""Tables of a labelled log: robots, and the share of each class."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import RenderableType

from octoreplay.labelling.label_log import LabelSummary
from octoreplay.report.tables import styled_table


def label_tables(summary: LabelSummary) -> Iterator[RenderableType]:
    """Yield the table of the robots and that of the classes of their labels."""
    robots = styled_table("Labelled")
    for name in ("robot", "sensor", "colour"):
        robots.add_column(name, overflow="fold")
    for name in ("labelled", "no image", "pixels with a label"):
        robots.add_column(name, justify="right", no_wrap=True)
    for robot in summary.robots:
        share = robot.labelled / robot.measured if robot.measured else 0.0
        robots.add_row(
            robot.robot_id, f"{robot.sensor_topic}\n{robot.alignment}", robot.colour_topic,
            f"{robot.num_labelled:,} of {robot.num_messages:,}", f"{robot.num_without_image:,}", f"{share:.1%}",
        )  # fmt: skip
    yield robots
    classes = styled_table("Classes")
    classes.add_column("class", overflow="fold")
    for robot in summary.robots:
        classes.add_column(robot.robot_id, justify="right", no_wrap=True)
    for name in dict.fromkeys(name for robot in summary.robots for name in robot.classes):
        shares = [robot.classes.get(name, 0) / robot.labelled if robot.labelled else 0.0 for robot in summary.robots]
        classes.add_row(name, *(f"{share:.2%}" for share in shares))
    yield classes
