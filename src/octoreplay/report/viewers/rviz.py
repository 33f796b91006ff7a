"""Configuration of RViz for a result, and the QoS with which 'ros2 bag play' offers its latched topics.

The display classes and their properties are those of rviz_default_plugins (ROS 2 Humble and later).
"""

from __future__ import annotations

import math
from typing import Any

from octoreplay.config.yaml_file import dump_yaml
from octoreplay.io.results.topics import (
    GRAPH_TOPIC,
    STATIC_TF_TOPIC,
    map_view_topic,
    markers_topic,
    pose_topic,
)
from octoreplay.report.figures import COLORS
from octoreplay.report.viewers.scene import Scene

_LATCHED = {"history": "keep_last", "depth": 1, "reliability": "reliable", "durability": "transient_local"}
_PLUGINS = "rviz_default_plugins"


def rviz_config(scene: Scene) -> str:
    """Return the configuration as YAML text: grid, frames, links, and each robot's map, cubes and pose.

    The first robot's map is shown, as cubes where the result has them; the others are there to be switched on.
    """
    displays = [_grid(scene), _frames()]
    if GRAPH_TOPIC in scene.topics:
        displays.append(_markers("Links", GRAPH_TOPIC, is_latched=False, is_shown=True))
    for index, robot_id in enumerate(scene.robots):
        cubes, points = markers_topic(robot_id), map_view_topic(robot_id)
        is_first = index == 0
        if cubes in scene.topics:
            displays.append(_markers(f"{robot_id}: cubes", cubes, is_latched=True, is_shown=is_first))
        if points in scene.topics:
            displays.append(_cloud(robot_id, points, scene, is_shown=is_first and cubes not in scene.topics))
        if pose_topic(robot_id) in scene.topics:
            displays.append(_pose(robot_id, COLORS[index % len(COLORS)]))
    return dump_yaml(
        {
            "Panels": [
                {"Class": "rviz_common/Displays", "Name": "Displays"},
                {"Class": "rviz_common/Views", "Name": "Views"},
                {"Class": "rviz_common/Time", "Name": "Time"},
            ],
            "Visualization Manager": {
                "Class": "",
                "Displays": displays,
                "Enabled": True,
                "Global Options": {
                    "Background Color": "48; 48; 48", "Fixed Frame": scene.frame_id, "Frame Rate": 30
                },
                "Name": "root",
                "Tools": [
                    {"Class": f"{_PLUGINS}/{tool}"} for tool in ("Interact", "MoveCamera", "Select", "FocusCamera")
                ],
                "Value": True,
                "Views": {"Current": _view(scene), "Saved": None},
            },
            "Window Geometry": {"Height": 900, "Width": 1400},
        },
        in_blocks=True,
    )  # fmt: skip


def playback_qos(scene: Scene) -> str:
    """Return the YAML text for ``ros2 bag play --qos-profile-overrides-path``: latched maps and static frames.

    RViz gets the last map of each robot also when it is started or when a display is switched on after the message.
    """
    latched = [STATIC_TF_TOPIC]
    for robot_id in scene.robots:
        latched += [map_view_topic(robot_id), markers_topic(robot_id)]
    return dump_yaml({topic: dict(_LATCHED) for topic in latched if topic in scene.topics}, in_blocks=True)


def _topic(name: str, *, is_latched: bool) -> dict[str, Any]:
    """Topic of a display with its QoS."""
    return {
        "Value": name,
        "Depth": 1 if is_latched else 10,
        "History Policy": "Keep Last",
        "Reliability Policy": "Reliable",
        "Durability Policy": "Transient Local" if is_latched else "Volatile",
    }


def _grid(scene: Scene) -> dict[str, Any]:
    """Grid around the robots' paths."""
    x, y, _ = scene.center
    return {
        "Class": f"{_PLUGINS}/Grid", "Name": "Grid", "Enabled": True, "Value": True, "Reference Frame": "<Fixed Frame>",
        "Plane": "XY", "Cell Size": 1, "Plane Cell Count": math.ceil(2 * scene.extent), "Color": "160; 160; 164",
        "Alpha": 0.3, "Offset": {"X": x, "Y": y, "Z": 0},
    }  # fmt: skip


def _frames() -> dict[str, Any]:
    """Frames of the robots."""
    return {
        "Class": f"{_PLUGINS}/TF", "Name": "Frames", "Enabled": False, "Value": False, "Show Names": True,
        "Show Axes": True, "Show Arrows": False, "Marker Scale": 2,
    }  # fmt: skip


def _markers(name: str, topic: str, *, is_latched: bool, is_shown: bool) -> dict[str, Any]:
    """Display of an array of markers."""
    return {
        "Class": f"{_PLUGINS}/MarkerArray", "Name": name, "Enabled": is_shown, "Value": is_shown,
        "Topic": _topic(topic, is_latched=is_latched),
    }  # fmt: skip


def _cloud(robot_id: str, topic: str, scene: Scene, *, is_shown: bool) -> dict[str, Any]:
    """Display of a map as boxes of the finest leaf's size, in the colours of the classes."""
    return {
        "Class": f"{_PLUGINS}/PointCloud2", "Name": f"{robot_id}: map", "Enabled": is_shown, "Value": is_shown,
        "Topic": _topic(topic, is_latched=True), "Style": "Boxes", "Size (m)": scene.resolution,
        "Color Transformer": "RGB8", "Position Transformer": "XYZ", "Alpha": 1, "Decay Time": 0, "Selectable": True,
        "Use Fixed Frame": True,
    }  # fmt: skip


def _pose(robot_id: str, color: str) -> dict[str, Any]:
    """Display of a robot's pose as an arrow."""
    red, green, blue = (int(color[start : start + 2], 16) for start in (1, 3, 5))
    return {
        "Class": f"{_PLUGINS}/Pose", "Name": f"{robot_id}: pose", "Enabled": True, "Value": True, "Shape": "Arrow",
        "Color": f"{red}; {green}; {blue}", "Alpha": 1, "Shaft Length": 0.8, "Shaft Radius": 0.06, "Head Length": 0.4,
        "Head Radius": 0.15, "Topic": _topic(pose_topic(robot_id), is_latched=False),
    }  # fmt: skip


def _view(scene: Scene) -> dict[str, Any]:
    """View from above at an angle onto the robots' paths."""
    x, y, z = scene.center
    return {
        "Class": f"{_PLUGINS}/Orbit", "Name": "Current View", "Target Frame": "<Fixed Frame>",
        "Value": "Orbit (rviz)", "Distance": round(1.6 * scene.extent, 2), "Pitch": 0.8, "Yaw": 0.8,
        "Focal Point": {"X": x, "Y": y, "Z": z}, "Near Clip Distance": 0.01,
    }  # fmt: skip
