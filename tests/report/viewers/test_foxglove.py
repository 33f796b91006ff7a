"""Layouts for Foxglove, checked by the types of the Python package foxglove-sdk and by the topics of the result."""

from __future__ import annotations

import dataclasses
import json
import re
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from foxglove import layouts
from rosbags.highlevel import AnyReader

from octoreplay.io.messages.ros_types import typestore
from octoreplay.report.viewers.foxglove import foxglove_layout
from octoreplay.report.viewers.scene import Scene, scene_of
from octoreplay.result import open_result
from support.fixture_paths import FIXTURES
from support.result_factory import write_result

RESULT = FIXTURES / "result_3.mcap"
CONFIGS = {
    "3D": layouts.ThreeDeeConfig, "Plot": layouts.PlotConfig, "Table": layouts.TableConfig,
    "StateTransitions": layouts.StateTransitionsConfig,
}  # fmt: skip
TOPIC_SETTINGS = {
    "sensor_msgs/msg/PointCloud2": layouts.BaseRendererPointCloudTopicSettings,
    "geometry_msgs/msg/PoseStamped": layouts.BaseRendererPoseTopicSettings,
    "visualization_msgs/msg/MarkerArray": layouts.BaseRendererRosMarkerTopicSettings,
}


def layout_of(path: Path) -> tuple[dict[str, Any], Scene]:
    with open_result(path) as result:
        scene = scene_of(result)
    return json.loads(foxglove_layout(scene)), scene


def snake(name: str) -> str:
    return re.sub("([A-Z])", lambda letter: f"_{letter[0].lower()}", name)


def parse(hint: Any, value: Any, topics: dict[str, str]) -> Any:
    """The value of a type of foxglove.layouts from JSON; raises for unknown keys and for values it does not allow."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        for part in parts:
            try:
                return parse(part, value, topics)
            except (TypeError, ValueError):
                continue
        raise ValueError(f"{value!r} is none of {hint}")
    if origin is typing.Literal:
        if value not in parts:
            raise ValueError(f"{value!r} is not one of {parts}")
        return value
    if origin is list:
        return [parse(parts[0], entry, topics) for entry in value]
    if origin is tuple:
        if len(value) != len(parts):
            raise ValueError(f"{value!r} has not {len(parts)} entries")
        return tuple(parse(part, entry, topics) for part, entry in zip(parts, value, strict=True))
    if origin is dict:
        return {key: parse(parts[1], entry, topics) for key, entry in value.items()}
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint, vars(layouts))
        if unknown := {snake(key) for key in value} - hints.keys():
            raise ValueError(f"{hint.__name__} has no {unknown}")
        fields = {}
        for key, entry in value.items():
            if hint is layouts.ThreeDeeConfig and key == "topics":
                fields[key] = {
                    topic: parse(TOPIC_SETTINGS[topics[topic]], item, topics) for topic, item in entry.items()
                }
            elif hint is layouts.ThreeDeeConfig and key == "layers":
                fields[key] = {
                    name: parse(layouts.BaseRendererGridLayerSettings, item, topics) for name, item in entry.items()
                }
            else:
                fields[snake(key)] = parse(hints[snake(key)], entry, topics)
        return hint(**fields)
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return value
    if not isinstance(hint, type) or not isinstance(value, hint):
        raise TypeError(f"{value!r} is not {hint}")
    return value


def panels_of(node: Any) -> Iterator[str]:
    """Panels in a part of the layout's tree."""
    if isinstance(node, str):
        yield node
    else:
        assert set(node) == {"direction", "first", "second", "splitPercentage"}
        assert node["direction"] in ("row", "column")
        assert 0 < node["splitPercentage"] < 100
        yield from panels_of(node["first"])
        yield from panels_of(node["second"])


def assert_is_layout(layout: dict[str, Any], topics: dict[str, str]) -> None:
    """Check the parts of an exported layout, and each panel by the SDK's type of its configuration."""
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    panels = layout["configById"]
    placed = list(panels_of(layout["layout"]))
    tabs = panels["Tab!tables"]
    assert 0 <= tabs["activeTabIdx"] < len(tabs["tabs"])
    placed += [tab["layout"] for tab in tabs["tabs"]]
    assert sorted(placed) == sorted(panels)
    for name, config in panels.items():
        kind = name.split("!")[0]
        if kind == "Tab":
            continue
        config = {key: value for key, value in config.items() if key != "foxglovePanelTitle"}
        parsed = json.loads(parse(CONFIGS[kind], config, topics).to_json())
        # Equal, and not only accepted: what the SDK writes for the parsed values is what the layout says.
        for key, value in config.items():
            if key not in ("topics", "layers"):
                assert parsed[key] == value
        for key in ("topics", "layers"):
            for entry, settings in config.get(key, {}).items():
                assert settings.items() <= parsed[key][entry].items()


def message_paths(layout: dict[str, Any]) -> list[str]:
    """Message paths of all panels."""
    found = []
    for config in layout["configById"].values():
        found += [series["value"] for series in config.get("paths", ())]
        found += [config["topicPath"]] if "topicPath" in config else []
    return found


def test_a_layout_has_the_published_format() -> None:
    layout, scene = layout_of(RESULT)
    assert_is_layout(layout, dict(scene.topics))
    kinds = {name.split("!")[0] for name in layout["configById"]}
    assert kinds == {"3D", "Plot", "Table", "Tab", "StateTransitions"}


def test_the_check_refuses_what_the_types_do_not_know() -> None:
    for key, value in (("colorMode", "pretty"), ("cubesize", 0.3), ("visible", "yes")):
        layout, scene = layout_of(RESULT)
        layout["configById"]["3D!maps"]["topics"]["/husky_1/map"][key] = value
        with pytest.raises((ValueError, TypeError)):
            assert_is_layout(layout, dict(scene.topics))


def test_the_view_shows_the_first_map_in_its_colours_and_all_poses_and_links() -> None:
    layout, scene = layout_of(RESULT)
    view = layout["configById"]["3D!maps"]
    assert view["followTf"] == scene.frame_id == "team"
    topics = view["topics"]
    assert topics.keys() <= scene.topics.keys()
    assert topics["/graph"]["visible"]
    for index, robot_id in enumerate(scene.robots):
        shown = topics[f"/{robot_id}/map"]
        assert (shown["visible"], shown["colorMode"], shown["cubeSize"]) == (index == 0, "rgb", scene.resolution)
        assert topics[f"/{robot_id}/pose"]["visible"]


@pytest.mark.parametrize("name", ["result_2.mcap", "result_3.mcap"])
def test_message_paths_lead_to_values_of_the_result(name: str) -> None:
    layout, scene = layout_of(FIXTURES / name)
    latest = {}
    with AnyReader([FIXTURES / name], default_typestore=typestore()) as reader:
        for connection, _, raw in reader.messages():
            latest[connection.topic] = reader.deserialize(raw, connection.msgtype)
    paths = message_paths(layout)
    assert len(paths) >= 3 + 4 * len(scene.robots)
    for path in paths:
        topic, *fields = path.split(".")
        value = latest[topic]
        for field in fields:
            attribute, _, index = field.rstrip("]").partition("[")
            value = getattr(value, attribute)
            if index:
                value = value[int(index)]
        assert isinstance(value, int | float | list)


def test_plots_name_each_robot_by_its_place_in_the_message() -> None:
    layout, _ = layout_of(RESULT)
    series = layout["configById"]["Plot!agreement"]["paths"]
    with open_result(RESULT) as result:
        order = [robot.robot_id for robot in result.metrics[0].robots]
    assert [(entry["label"], entry["value"]) for entry in series] == [
        (robot_id, f"/metrics.robots[{index}].agreement") for index, robot_id in enumerate(order)
    ]


def test_a_layout_without_a_result_has_the_panels_of_the_team() -> None:
    layout = json.loads(foxglove_layout(Scene()))
    assert_is_layout(layout, {"/graph": "visualization_msgs/msg/MarkerArray"})
    assert not [path for path in message_paths(layout) if "robots[" in path]
    assert "Plot!agreement" not in layout["configById"]


def test_a_result_without_maps_has_no_topic_of_a_map(tmp_path: Path) -> None:
    layout, scene = layout_of(write_result(tmp_path))
    assert_is_layout(layout, dict(scene.topics))
    assert set(layout["configById"]["3D!maps"]["topics"]) == {"/graph", "/alpha/pose", "/beta/pose"}
