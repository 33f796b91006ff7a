"""Table of the quality of odometry."""

from __future__ import annotations

from rich.console import RenderableType

from octoreplay.odometry.estimate import OdometryResult
from octoreplay.odometry.source import OdometrySource, SensorKind
from octoreplay.report.tables import seconds, styled_table

_METHODS = {
    SensorKind.LIDAR: "point-to-point registration to a local map (KISS-ICP)",
    SensorKind.RGBD: "depth and brightness, registered to key frames (Open3D)",
    SensorKind.DEPTH: "depth, registered to key frames (Open3D)",
}


def quality_table(source: OdometrySource, result: OdometryResult) -> RenderableType:
    """Return the sensor, the method, and the quality of the poses as a table."""
    table = styled_table("Odometry")
    table.show_header = False
    table.add_column("quantity", no_wrap=True)
    table.add_column("value", overflow="fold")
    quality = result.quality
    span = (int(result.stamps_ns[-1]) - int(result.stamps_ns[0])) / 1e9
    wheels = "" if source.wheels is None else f"{source.wheels.pose_topic}, for {quality.num_by_wheels:,} scans"
    turns = "" if result.imu_topic is None else f", rotation by {result.imu_topic} for {quality.num_by_imu:,} scans"
    vertical = f"gravity by {result.imu_topic}" if result.is_level else f"the axis of {result.body_frame}"
    color = f" with {source.color_topic}" if source.color_topic else ""
    lost = (
        f"{quality.num_low_overlap:,} low overlap, {quality.num_unconstrained:,} open direction, "
        f"{quality.num_jumps:,} jumps"
    )
    overlap = f"{100 * quality.median_overlap:.0f} % of the points median, {100 * quality.least_overlap:.0f} % at least"
    rows = (
        ("sensor", f"{source.robot.sensor_topic}{color}"),
        ("method", _METHODS[source.kind]),
        ("expected motion", wheels or f"the last motion{turns}"),
        ("vertical", vertical),
        ("poses of", f"{result.frame}, in a map that begins at {result.body_frame}"),
        ("scans", f"{quality.num_scans:,} in {seconds(span)}"),
        ("registered", f"{quality.num_registered:,} ({100 * quality.registered_share:.1f} %)"),
        ("left out", lost),
        ("breaks", f"{quality.num_breaks:,}"),
        ("overlap", overlap),
        ("residual", f"{quality.median_residual:.4f} m median, {quality.largest_residual:.4f} m at most"),
        ("way", f"{quality.length:.2f} m"),
    )  # fmt: skip
    for row in rows:
        table.add_row(*row)
    return table
