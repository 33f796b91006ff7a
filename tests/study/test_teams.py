"""Simulated teams and results that are used again."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import InputError, OutputError
from octoreplay.replay.run import Progress
from octoreplay.result import open_result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.study import teams
from octoreplay.study.teams import is_replayed, is_simulated, replayed_team, simulated_team

pytest.importorskip("open3d", exc_type=ImportError)

SMALL = SimulationConfig(num_robots=2, duration=2.0, rate=2.0, image=(32, 24), seed=5, world_size=24.0)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A team and its result."""
    folder = tmp_path_factory.mktemp("stored")
    team_file = simulated_team(folder / "team", SMALL)
    replayed_team(load_team_file(team_file), folder / "result.mcap")
    return folder


@pytest.fixture
def made(stored: Path, tmp_path: Path) -> Path:
    """A copy of them, which a test may change."""
    return Path(shutil.copytree(stored, tmp_path / "made"))


def content(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Content and time of change of every file."""
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in folder.rglob("*")
        if path.is_file()
    }


# --- teams -----------------------------------------------------------------------------------------------------------


def test_a_team_is_simulated_once(stored: Path) -> None:
    before = content(stored)
    shares: list[float] = []
    team_file = simulated_team(stored / "team", SMALL, shares.append)
    assert load_team_file(team_file).robots[1].robot_id == "husky_2"
    assert shares == []
    assert content(stored) == before


def test_missing_and_empty_folders_hold_no_team(tmp_path: Path) -> None:
    assert not is_simulated(tmp_path / "none", SMALL)
    assert not is_simulated(tmp_path, SMALL)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"seed": 6}, "holds a team with seed 5, not 6"),
        ({"duration": 3.0}, "holds a team with duration 2.0, not 3.0"),
        ({"image": (40, 30)}, r"holds a team with image \[32, 24\], not \[40, 30\]"),
    ],
)
def test_a_team_of_other_settings_is_refused(stored: Path, change: dict[str, object], sentence: str) -> None:
    before = content(stored)
    with pytest.raises(OutputError, match=rf"team: {sentence}; give another folder"):
        simulated_team(stored / "team", dataclasses.replace(SMALL, **change))
    assert content(stored) == before


def test_a_team_of_another_version_is_refused(stored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(teams, "__version__", "9.9.9")
    with pytest.raises(OutputError, match=r"was simulated by octoreplay 0\.\S+, this is 9\.9\.9"):
        simulated_team(stored / "team", SMALL)


def test_a_team_that_has_changed_is_refused(made: Path) -> None:
    log = made / "team" / "husky_1.mcap"
    log.write_bytes(log.read_bytes()[:-1])
    with pytest.raises(OutputError, match=r"team: 'husky_1\.mcap' is missing or has changed since it was simulated"):
        simulated_team(made / "team", SMALL)
    log.unlink()
    with pytest.raises(OutputError, match=r"team: 'husky_1\.mcap' is missing or has changed"):
        simulated_team(made / "team", SMALL)


@pytest.mark.parametrize("text", [None, "no json", "[]", '{"files": {}}'])
def test_a_folder_that_holds_something_else_is_refused(tmp_path: Path, text: str | None) -> None:
    (tmp_path / "diary.txt").write_text("mine")
    if text is not None:
        (tmp_path / "simulation.json").write_text(text)
    with pytest.raises(OutputError, match="exists and holds no simulated team; give another folder"):
        simulated_team(tmp_path, SMALL)
    assert (tmp_path / "diary.txt").read_text() == "mine"


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "team").write_text("mine")
    with pytest.raises(OutputError, match="holds no simulated team"):
        simulated_team(tmp_path / "team", SMALL)
    with pytest.raises(OutputError, match=r"inside: cannot be written: (File exists|Not a directory)"):
        simulated_team(tmp_path / "team" / "inside", SMALL)


def test_an_interrupted_simulation_leaves_nothing(tmp_path: Path) -> None:
    def interrupt(share: float) -> None:
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulated_team(tmp_path / "team", SMALL, interrupt)
    assert list(tmp_path.iterdir()) == []


def test_a_simulation_that_cannot_be_finished_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: str) -> None:
        raise OutputError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr(teams, "write_whole", full)
    with pytest.raises(OutputError, match="No space left on device"):
        simulated_team(tmp_path / "team", SMALL)
    assert list(tmp_path.iterdir()) == []


def test_the_remains_of_a_killed_simulation_are_removed(stored: Path, tmp_path: Path) -> None:
    left = tmp_path / ".team.0a1b2c3d.tmp"
    left.mkdir()
    (left / "husky_7.mcap").write_text("half")
    simulated_team(tmp_path / "team", SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["team"]
    again, before = content(tmp_path / "team"), content(stored / "team")
    assert {name: data for name, (_, data) in again.items()} == {name: data for name, (_, data) in before.items()}


# --- results ---------------------------------------------------------------------------------------------------------


def test_a_team_is_replayed_once(stored: Path) -> None:
    before = content(stored)
    config = load_team_file(stored / "team" / "team.yaml")
    assert is_replayed(config, stored / "result.mcap")
    assert replayed_team(config, stored / "result.mcap", pytest.fail) == stored / "result.mcap"
    assert content(stored) == before


def test_a_result_of_other_settings_is_refused(stored: Path) -> None:
    config = load_team_file(stored / "team" / "team.yaml").with_parameters({"rule": "gradient"})
    assert not is_replayed(config, stored / "other.mcap")
    with pytest.raises(OutputError, match=r"result\.mcap: exists and was made from other logs, with other settings"):
        replayed_team(config, stored / "result.mcap")


def test_a_result_of_logs_that_have_changed_is_refused(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_team_file(made / "team" / "team.yaml")
    assert is_replayed(config, made / "result.mcap")
    with (made / "team" / "husky_2.mcap").open("ab") as log:
        log.write(b"more")
    with pytest.raises(OutputError, match="made from other logs"):
        is_replayed(config, made / "result.mcap")


def test_a_result_of_another_version_is_refused(stored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(teams, "__version__", "9.9.9")
    with pytest.raises(OutputError, match="by another version"):
        is_replayed(load_team_file(stored / "team" / "team.yaml"), stored / "result.mcap")


def test_a_file_that_is_not_a_result_is_refused(made: Path) -> None:
    (made / "result.mcap").write_text("mine")
    with pytest.raises(InputError, match=r"result\.mcap: not a finished MCAP file, or damaged"):
        replayed_team(load_team_file(made / "team" / "team.yaml"), made / "result.mcap")


def test_an_interrupted_replay_is_continued(stored: Path, tmp_path: Path) -> None:
    ticks: list[int] = []

    def interrupt(progress: Progress) -> None:
        ticks.append(progress.tick)
        if progress.tick == 1:
            raise KeyboardInterrupt

    config = load_team_file(stored / "team" / "team.yaml")
    with pytest.raises(KeyboardInterrupt):
        replayed_team(config, tmp_path / "result.mcap", interrupt)
    replayed_team(config, tmp_path / "result.mcap", lambda progress: ticks.append(progress.tick))
    assert ticks == list(range(len(ticks)))
    assert [path.name for path in tmp_path.iterdir()] == ["result.mcap"]
    with open_result(tmp_path / "result.mcap") as result:
        assert result.is_complete
