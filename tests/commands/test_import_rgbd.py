"""import-rgbd as a process: one sequence, and a folder of sequences."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.command_line import assert_fails, octoreplay
from support.poses import pose


@pytest.fixture
def sequences(tmp_path: Path) -> Path:
    """A folder with two sequences, the second without the pose of its last image."""
    for name, count in (("seq-01", 3), ("seq-02", 2)):
        folder = tmp_path / "scene" / name
        folder.mkdir(parents=True)
        for index in range(3):
            Image.fromarray(np.full((4, 6), 1000, np.uint16)).save(folder / f"frame-{index:06d}.depth.png")
            if index < count:
                np.savetxt(folder / f"frame-{index:06d}.pose.txt", pose(index))
        (folder / "camera-intrinsics.txt").write_text("4 0 2.5\n0 4 1.5\n0 0 1\n")
    return tmp_path / "scene"


def test_a_folder_of_sequences_gives_a_log_of_each(sequences: Path, tmp_path: Path) -> None:
    done = octoreplay("import-rgbd", sequences, "-o", tmp_path / "logs", "--rate", "10", "--json")
    assert done.returncode == 3, done.stderr
    assert "seq-02.mcap: 1 images without a usable pose were skipped" in done.stderr
    first, second = json.loads(done.stdout)["logs"]
    assert (first["robot_id"], first["num_frames"], second["robot_id"]) == ("seq_01", 3, "seq_02")
    names = sorted(path.name for path in (tmp_path / "logs").glob("*.mcap"))
    assert names == ["seq-01.mcap", "seq-02.mcap"]
    info = octoreplay("info", *(tmp_path / "logs" / name for name in names))
    assert info.returncode == 0, info.stderr
    refused = "logs: already exists; give another name, or use --force"
    assert_fails(1, refused, "import-rgbd", sequences, "-o", tmp_path / "logs", "--rate", "10")


def test_one_sequence_gives_one_log(sequences: Path, tmp_path: Path) -> None:
    done = octoreplay("import-rgbd", sequences / "seq-01", "-o", tmp_path / "a.mcap", "--rate", "10", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert (document["layout"], document["robot_id"]) == ("7-Scenes", "a")
    assert document["log"] == str(tmp_path / "a.mcap")


def test_wrong_use_is_named(sequences: Path, tmp_path: Path) -> None:
    log, logs = tmp_path / "a.mcap", tmp_path / "logs"
    remedy = "holds 2 RGB-D sequences such as seq-01; name a folder as output"
    assert_fails(1, remedy, "import-rgbd", sequences, "-o", log, "--rate", "10")
    assert_fails(2, "--robot names one robot", "import-rgbd", sequences, "-o", logs, "--rate", "10", "--robot", "r")
    assert_fails(2, "logs: .*must end in .mcap", "import-rgbd", sequences / "seq-01", "-o", logs, "--rate", "10")
    assert not logs.exists()
