"""GrAco: a ground vehicle and a multicopter with a Velodyne lidar on a campus (Zhu and others)."""

from __future__ import annotations

from types import MappingProxyType

from octoreplay.io.datasets.catalogue.bags import Bags

DATA_SET = Bags(
    name="graco",
    title="GrAco",
    holds="a ROS 1 or ROS 2 bag for each sequence, such as ground-01 or aerial-01-40m",
    checked="a launch file of Swarm-SLAM (topic of the ROS 2 bags); those of the ROS 1 bags were not found",
    sources=(
        "https://github.com/SYSU-RoboticsLab/GrAco",
        "https://github.com/lajoiepy/cslam_experiments/blob/main/launch/sensors/bag_graco.launch.py",
    ),
    notes=("Each sequence is a robot. If the times of sequences do not overlap, set clock_offset.",),
    topic=r"/velodyne/points|/velodyne_points",
    example="/velodyne/points",
    no_poses="the frame of the ground truth and its transform to the lidar are not in the published text",
    map_frame="odom",
    parameters=MappingProxyType({"max_range": 40.0}),
)
