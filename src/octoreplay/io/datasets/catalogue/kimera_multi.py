"""Kimera-Multi-Data: eight Jackals with a RealSense D455 on a campus (Tian and others 2023)."""

from __future__ import annotations

from types import MappingProxyType

from octoreplay.io.datasets.catalogue.bags import Bags

DATA_SET = Bags(
    name="kimera-multi",
    title="Kimera-Multi-Data",
    holds="a ROS 1 bag for each robot, and ground_truth/SEQUENCE/ROBOT_gt_odom.csv",
    checked="documentation (topics); the authors' tools (pose files and their frames, camera extrinsics)",
    sources=(
        "https://github.com/MIT-SPARK/Kimera-Multi-Data",
        "https://github.com/plusk01/Kimera-Multi-Data/tree/parker/kmd_tools",
    ),
    notes=(
        "The depth camera is used; the lidars of three robots differ from the others (topics ROBOT/lidar_points).",
        "The poses are those of base_link, and the tools put the camera at its origin.",
    ),
    topic=r"/(?P<robot>[^/]+)/forward/depth/image_rect_raw",
    example="/acl_jackal/forward/depth/image_rect_raw",
    role="depth_topic",
    camera_info="/{robot}/forward/depth/camera_info",
    pose_file="{robot}_gt_odom.csv",
    map_frame="map",
    # kmd_tools: T_baselink_cameralink and T_cameralink_infra1 are identities, and depth is in the frame of infra1.
    T_body_sensor=(0.0, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5),
    parameters=MappingProxyType({"max_range": 8.0, "pose_gap": 2.0}),
)
