"""S3E: three ground robots with a Velodyne VLP-16 and stereo cameras (Feng and others 2022)."""

from __future__ import annotations

from types import MappingProxyType

from octoreplay.io.datasets.catalogue.bags import Bags

DATA_SET = Bags(
    name="s3e",
    title="S3E",
    holds="a ROS 2 bag for each sequence with the robots Alpha, Bob and Carol, and ROBOT_gt.txt",
    checked="a launch file of Swarm-SLAM (topics); answers of the authors (pose files)",
    sources=(
        "https://pengyu-team.github.io/S3E",
        "https://github.com/lajoiepy/cslam_experiments/blob/main/launch/sensors/bag_s3e.launch.py",
        "https://github.com/DapengFeng/S3E/issues/2",
    ),
    notes=("The robots share one clock. Odometry starts in a frame of each robot: find T_team_map by align.",),
    topic=r"/(?P<robot>Alpha|Bob|Carol)/velodyne_points",
    example="/Alpha/velodyne_points",
    no_poses="the ground truth has UTM positions of the GPS antenna and the identity as every rotation",
    map_frame="odom",
    parameters=MappingProxyType({"max_range": 40.0}),
)
