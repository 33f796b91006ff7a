"""Paths files: waypoints of simulated robots."""

from __future__ import annotations

import pytest

from octoreplay.config.paths_file import load_paths_file
from octoreplay.errors import ConfigError


def test_the_paths_are_in_the_order_of_the_robots(tmp_path):
    text = "paths:\n  husky_2: [[5, 0]]\n  husky_1:\n  - [0, 0]\n  - [1.5, -2e1]\n"
    (tmp_path / "paths.yaml").write_text(text)
    assert load_paths_file(tmp_path / "paths.yaml") == (((0.0, 0.0), (1.5, -20.0)), ((5.0, 0.0),))
    assert load_paths_file(str(tmp_path / "paths.yaml"))[1] == ((5.0, 0.0),)


def test_eleven_robots_are_in_the_order_of_their_numbers(tmp_path):
    rows = [f"  husky_{number}: [[{number}, 0]]" for number in range(11, 0, -1)]
    (tmp_path / "paths.yaml").write_text("\n".join(["paths:", *rows]))
    assert [path[0][0] for path in load_paths_file(tmp_path / "paths.yaml")] == list(range(1, 12))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expects the single key 'paths' with"),
        ("husky_1: [[0, 0]]", "expects the single key 'paths' with"),
        ("paths: [[0, 0]]", "expects the single key 'paths' with"),
        ("paths: {}", "expects paths of husky_1, husky_2, ..., without gaps, not of no robot"),
        ("paths: {spot: [[0, 0]]}", "expects paths of husky_1, husky_2, ..., without gaps, not of spot"),
        (
            "paths: {husky_1: [[0, 0]], husky_3: [[0, 0]]}",
            "expects paths of .* gaps, not of husky_1, husky_3",
        ),
        ("paths: {husky_1: [[0, 0]], husky_1: [[0, 0]]}", "not valid YAML"),
        ("paths: {husky_1: []}", r"robot 'husky_1': expects a list of waypoints \[x, y\], not \[\]"),
        ("paths: {husky_1: 5}", r"robot 'husky_1': expects a list of waypoints \[x, y\], not 5"),
        ("paths: {husky_1: [[0, 0], [1]]}", r"robot 'husky_1': waypoint 2: expects \[x, y\] in metres, not \[1\]"),
        ("paths: {husky_1: [[0, 0, 0]]}", r"robot 'husky_1': waypoint 1: expects \[x, y\] in metres"),
        ("paths: {husky_1: ['12']}", r"robot 'husky_1': waypoint 1: expects \[x, y\] in metres, not '12'"),
        ("paths: {husky_1: [[a, 0]]}", r"robot 'husky_1': waypoint 1: expects \[x, y\] in metres"),
        ("paths: {husky_1: [[true, 0]]}", r"robot 'husky_1': waypoint 1: expects \[x, y\] in metres"),
        ("paths: {husky_1: [[.inf, 0]]}", r"robot 'husky_1': waypoint 1: expects \[x, y\] in metres"),
    ],
)
def test_wrong_files_are_refused(tmp_path, text, message):
    (tmp_path / "paths.yaml").write_text(text)
    with pytest.raises(ConfigError, match=f"paths.yaml: {message}"):
        load_paths_file(tmp_path / "paths.yaml")


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read: No such file"):
        load_paths_file(tmp_path / "none.yaml")
