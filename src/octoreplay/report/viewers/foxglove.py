"""Layout of Foxglove for a result, in the JSON format that the app exports and imports.

The panels' configurations are those of the types in ``foxglove.layouts`` of the Python package foxglove-sdk.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from octoreplay.io.results.topics import (
    CONTRADICTION_TOPIC,
    GRAPH_TOPIC,
    METRICS_TOPIC,
    map_view_topic,
    markers_topic,
    pose_topic,
)
from octoreplay.report.figures import COLORS
from octoreplay.report.viewers.scene import Scene

_SCENE, _TABLES = "3D!maps", "Tab!tables"


def foxglove_layout(scene: Scene) -> str:
    """Return the layout as JSON text: 3-D view, plots, tables and the robots' activity.

    A scene of unknown robots gives the panels of the team only.
    """
    plots, tables = _plots(scene), _tables(scene)
    tabs = [{"title": panel["foxglovePanelTitle"], "layout": name} for name, panel in tables.items()]
    left = {"direction": "column", "first": _SCENE, "second": _TABLES, "splitPercentage": 68}
    layout = {
        "configById": {_SCENE: _three_dee(scene), _TABLES: {"activeTabIdx": 0, "tabs": tabs}, **plots, **tables},
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": left, "second": _stack(list(plots)), "splitPercentage": 62},
    }
    return json.dumps(layout, indent=2, ensure_ascii=False) + "\n"


def _plots(scene: Scene) -> dict[str, Any]:
    """Plot panels by name, from top to bottom."""
    team, pairs = f"{METRICS_TOPIC}.", f"{CONTRADICTION_TOPIC}."
    labels = [(f"{team}label_disagreement", "label disagreement")]
    if _has_pairs(scene):
        labels += [(f"{pairs}contradiction", "contradiction"), (f"{pairs}clear_contradiction", "clear contradiction")]
    distances = [("total_distance", "Φ over the links"), ("total_distance_all", "Φ over all pairs")]
    plots = {
        "Plot!distance": _plot("Disagreement Φ", [(team + name, label) for name, label in distances]),
        "Plot!labels": _plot("Labels and contradiction", labels),
    }
    if scene.robots:
        plots["Plot!agreement"] = _plot("Agreement with the centralised map", _of_robots(scene, "agreement"))
        plots["Plot!bytes"] = _plot("Bytes sent per tick", _of_robots(scene, "sent_bytes"))
    return plots


def _tables(scene: Scene) -> dict[str, Any]:
    """Panels of the tabs by name: tables of the last tick, and the robots' activity over time."""
    tables = {
        "Table!robots": _table("Robots", f"{METRICS_TOPIC}.robots"),
        "Table!links": _table("Links", f"{METRICS_TOPIC}.links"),
    }
    if _has_pairs(scene):
        tables["Table!pairs"] = _table("Pairs of robots", f"{CONTRADICTION_TOPIC}.pairs")
    states = [(f"{METRICS_TOPIC}.settling", "settling")]
    states += [(path, f"{robot_id} active") for path, robot_id in _of_robots(scene, "active")]
    tables["StateTransitions!activity"] = _states(states)
    return tables


def _has_pairs(scene: Scene) -> bool:
    """True unless the result was written before the contradiction of evidence was measured."""
    return not scene.topics or CONTRADICTION_TOPIC in scene.topics


def _of_robots(scene: Scene, name: str) -> list[tuple[str, str]]:
    """Message path of a metric of each robot, with the robot's name."""
    return [(f"{METRICS_TOPIC}.robots[{index}].{name}", robot_id) for index, robot_id in enumerate(scene.robots)]


def _stack(panels: Sequence[str]) -> Any:
    """Panels below each other, of equal height."""
    first, *others = panels
    if not others:
        return first
    share = round(100 / len(panels), 2)
    return {"direction": "column", "first": first, "second": _stack(others), "splitPercentage": share}


def _three_dee(scene: Scene) -> dict[str, Any]:
    """3-D panel: the first robot's map, all poses, the links; the other maps are there to be switched on."""
    topics: dict[str, Any] = {GRAPH_TOPIC: {"visible": True}}
    for index, robot_id in enumerate(scene.robots):
        topics[pose_topic(robot_id)] = {"visible": True, "type": "axis", "axisScale": 1.0}
        topics[map_view_topic(robot_id)] = {
            # Equal cubes of several robots in one place would flicker.
            "visible": index == 0,
            "colorMode": "rgb",
            "colorField": "rgb",
            "pointShape": "cube",
            "cubeSize": scene.resolution,
        }
        topics[markers_topic(robot_id)] = {"visible": False}
    if scene.topics:
        topics = {topic: settings for topic, settings in topics.items() if topic in scene.topics}
    grid = {
        "visible": True, "layerId": "foxglove.Grid", "instanceId": "grid", "label": "Grid", "frameId": scene.frame_id,
        "size": round(2 * scene.extent), "divisions": 20, "lineWidth": 1, "color": "#88888866",
        "position": [*scene.center[:2], 0.0], "rotation": [0, 0, 0], "order": 1,
    }  # fmt: skip
    return {
        "followTf": scene.frame_id,
        "followMode": "follow-none",
        "cameraState": {
            "perspective": True, "distance": round(1.6 * scene.extent, 2), "phi": 45, "thetaOffset": 45, "fovy": 45,
            "near": 0.1, "far": 5000, "targetOffset": list(scene.center),
        },
        "scene": {"transforms": {"showLabel": False, "axisSize": 0.5}},
        "layers": {"grid": grid},
        "topics": topics,
    }  # fmt: skip


def _plot(title: str, series: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Plot panel over log time; a series is a message path and its label."""
    return {
        "foxglovePanelTitle": title,
        "paths": [
            {
                "value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime", "showLine": True,
                "lineSize": 1.5, "color": COLORS[index % len(COLORS)],
            }
            for index, (path, label) in enumerate(series)
        ],
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": True,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
    }  # fmt: skip


def _table(title: str, path: str) -> dict[str, Any]:
    """Table panel of the records at a message path."""
    return {"foxglovePanelTitle": title, "topicPath": path}


def _states(series: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """State transitions panel of message paths with their labels."""
    paths = [{"value": path, "label": label, "timestampMethod": "receiveTime"} for path, label in series]
    return {"foxglovePanelTitle": "Activity", "paths": paths, "isSynced": True}
