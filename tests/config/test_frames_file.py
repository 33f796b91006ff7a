"""Frames files: T_team_map by robot id."""

from __future__ import annotations

import pytest

from octoreplay.config.frames_file import dump_frames, load_frames_file
from octoreplay.errors import ConfigError


def test_the_numbers_are_read_back(tmp_path):
    frames = {"spot": (0.1 + 0.2, -1e-17, 1e9, 0.6, 0.0, 0.0, 0.8), "7": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}
    (tmp_path / "frames.yaml").write_text(dump_frames(frames))
    assert load_frames_file(tmp_path / "frames.yaml") == frames
    assert list(load_frames_file(str(tmp_path / "frames.yaml"))) == ["spot", "7"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expects the single key 'T_team_map' with"),
        ("spot: [0, 0, 0, 0, 0, 0, 1]", "expects the single key 'T_team_map' with"),
        ("T_team_map: [0, 0, 0, 0, 0, 0, 1]", "expects the single key 'T_team_map' with"),
        ("T_team_map: {a: [0, 0, 0, 0, 0, 0, 1], a: [1, 0, 0, 0, 0, 0, 1]}", "not valid YAML"),
        ("T_team_map: {a: 5}", "robot 'a': T_team_map: 5 has the wrong type"),
        ("T_team_map: {a: [0, 0, 0, 0, 0, 0, true]}", "robot 'a': T_team_map: .* has the wrong type"),
        ("T_team_map: {a: [0, 0, 0, 0, 0, 1]}", "robot 'a': T_team_map expects 7 numbers"),
        ("T_team_map: {a: [.inf, 0, 0, 0, 0, 0, 1]}", "robot 'a': T_team_map must be finite"),
        ("T_team_map: {a: [0, 0, 0, 0, 0, 0, 2]}", "robot 'a': T_team_map's quaternion must have length 1"),
    ],
)
def test_wrong_files_are_refused(tmp_path, text, message):
    (tmp_path / "frames.yaml").write_text(text)
    with pytest.raises(ConfigError, match=f"frames.yaml: {message}"):
        load_frames_file(tmp_path / "frames.yaml")


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read: No such file"):
        load_frames_file(tmp_path / "none.yaml")
