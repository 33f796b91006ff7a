"""CU-Multi: four runs of a Hunter robot at two places of a campus, with semantic lidar (Albin and others 2025)."""

from __future__ import annotations

from types import MappingProxyType

from octoreplay.io.datasets.catalogue.bags import Bags

DATA_SET = Bags(
    name="cu-multi",
    title="CU-Multi",
    holds="folders ENVIRONMENT/ROBOT with a ROS 2 bag ROBOT-ENVIRONMENT_lidar and ROBOT_gt_utm_poses.csv",
    checked=(
        "documentation (files, topics, label_id, frame of the poses); two reference trajectories of the authors "
        "(columns, UTM coordinates)"
    ),
    sources=("https://github.com/arpg/CU-Multi", "https://arxiv.org/abs/2509.19463"),
    notes=(
        "Poses are those of the lidar in UTM coordinates; pose_origin is common to the robots.",
        (
            "Where the clouds have the field label_id, it is used: the ids of SemanticKITTI, and 45 (building) and "
            "46 (sidewalk) from OpenStreetMap, as in the authors' tools."
        ),
    ),
    topic=r"/?(?P<robot>robot\d+)/ouster/points",
    example="robot1/ouster/points",
    pose_file="{robot}_gt_utm_poses.csv",
    map_frame="utm",
    T_body_sensor=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    is_utm=True,
    classes="semantickitti",
    label_field="label_id",
    # Buildings and paths that are taken from OpenStreetMap (make_ros2_bag.py).
    added_labels=MappingProxyType({45: "building", 46: "sidewalk"}),
    parameters=MappingProxyType({"max_range": 40.0}),
)
