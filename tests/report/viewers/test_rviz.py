"""Configurations of RViz, and the QoS of the topics that RViz subscribes to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from octoreplay.io.results.map_views import view_points
from octoreplay.report.viewers.rviz import playback_qos, rviz_config
from octoreplay.report.viewers.scene import scene_of
from octoreplay.result import open_result
from support.fixture_paths import FIXTURES
from support.result_factory import CLASSES, SECOND, START, leaf_table, write_result

TYPES = {
    "rviz_default_plugins/PointCloud2": "sensor_msgs/msg/PointCloud2",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Pose": "geometry_msgs/msg/PoseStamped",
}


def files_of(path: Path) -> tuple[dict[str, Any], dict[str, Any], dict[str, str]]:
    """Configuration, QoS and topics of a result."""
    with open_result(path) as result:
        scene = scene_of(result)
    yaml = YAML(typ="safe", pure=True)
    return yaml.load(rviz_config(scene)), yaml.load(playback_qos(scene)), dict(scene.topics)


def displays_of(config: dict[str, Any]) -> dict[str, Any]:
    """Displays by name."""
    found = {display["Name"]: display for display in config["Visualization Manager"]["Displays"]}
    assert len(found) == len(config["Visualization Manager"]["Displays"])
    return found


def test_every_display_has_a_topic_of_the_result_with_the_type_it_shows() -> None:
    config, _, topics = files_of(FIXTURES / "result_3.mcap")
    displays = displays_of(config)
    shown = {name: display["Topic"]["Value"] for name, display in displays.items() if "Topic" in display}
    assert set(shown.values()) == {
        "/graph", "/husky_1/map", "/husky_2/map", "/husky_1/pose", "/husky_2/pose"
    }  # fmt: skip
    for name, topic in shown.items():
        assert topics[topic] == TYPES[displays[name]["Class"]]
    assert config["Visualization Manager"]["Global Options"]["Fixed Frame"] == "team"
    assert [display["Enabled"] for name, display in displays.items() if name.endswith(": map")] == [True, False]
    assert all(display["Value"] == display["Enabled"] for display in displays.values())


def test_latched_topics_have_the_same_durability_on_both_sides() -> None:
    config, qos, topics = files_of(FIXTURES / "result_3.mcap")
    assert set(qos) == {"/tf_static", "/husky_1/map", "/husky_2/map"} <= topics.keys()
    assert {profile["durability"] for profile in qos.values()} == {"transient_local"}
    for display in displays_of(config).values():
        if "Topic" in display:
            is_latched = display["Topic"]["Durability Policy"] == "Transient Local"
            assert is_latched == (display["Topic"]["Value"] in qos)


def test_cubes_take_the_place_of_points_where_the_result_has_them(tmp_path: Path) -> None:
    def fill(writer: Any) -> None:
        points = view_points(leaf_table(), CLASSES)
        for robot_id in ("alpha", "beta"):
            writer.write_view(robot_id, START + SECOND, points)
            writer.write_cubes(robot_id, START + SECOND, points)

    config, qos, _ = files_of(write_result(tmp_path, fill))
    shown = {name: display["Enabled"] for name, display in displays_of(config).items() if "Topic" in display}
    assert shown == {
        "Links": True, "alpha: cubes": True, "alpha: map": False, "alpha: pose": True, "beta: cubes": False,
        "beta: map": False, "beta: pose": True,
    }  # fmt: skip
    assert {"/alpha/markers", "/beta/markers"} <= qos.keys()


def test_the_view_looks_at_the_robots_paths(tmp_path: Path) -> None:
    config, _, _ = files_of(write_result(tmp_path))
    view = config["Visualization Manager"]["Views"]["Current"]
    # Poses from x 0 to 4, at y 2 and z 3.
    assert view["Focal Point"] == {"X": 2.0, "Y": 2.0, "Z": 3.0}
    assert view["Distance"] == 1.6 * 5


def test_every_key_and_its_value_are_in_one_line() -> None:
    with open_result(FIXTURES / "result_3.mcap") as result:
        text = rviz_config(scene_of(result))
    # Some YAML readers refuse keys that are broken across lines.
    assert "{" not in text
    assert all(":" in line or line.lstrip().startswith("- ") for line in text.splitlines())
