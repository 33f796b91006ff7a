"""NTU VIRAL: a multicopter with two Ouster OS1-16 (Nguyen and others 2022)."""

from __future__ import annotations

from types import MappingProxyType

from octoreplay.io.datasets.catalogue.bags import Bags

DATA_SET = Bags(
    name="ntu-viral",
    title="NTU VIRAL",
    holds="a ROS 1 bag for each sequence, such as eee_01.bag",
    checked="documentation (topics, types, ground truth)",
    sources=(
        "https://ntu-aris.github.io/ntu_viral_dataset/sensors_and_usage.html",
        "https://github.com/ntu-aris/ntu_viral_dataset",
    ),
    notes=("The horizontal lidar is used. Sequences are flights of one vehicle at different times.",),
    topic=r"/os1_cloud_node1/points",
    example="/os1_cloud_node1/points",
    no_poses="the ground truth has positions of a prism without rotations (/leica/pose/relative)",
    map_frame="odom",
    parameters=MappingProxyType({"max_range": 40.0}),
)
