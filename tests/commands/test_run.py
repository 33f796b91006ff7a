"""The command 'run' on the small recorded teams."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from mcap.reader import make_reader

from octoreplay.commands import running, team_options
from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.result import open_result
from support.command_line import assert_fails, octoreplay, octoreplay_process, started, wait_for
from support.fixture_paths import PAIR, PAIR_TEAM, TRIO
from support.long_suite import long


def test_every_parameter_is_an_option() -> None:
    names = {name: option for option in running.run.params for name in option.opts}
    for name, parameter in PARAMETERS.items():
        option = names[f"--{name.replace('_', '-')}"]
        assert option.name == name
        assert parameter.help in (option.help or "")


def parsed(*arguments: str) -> dict[str, object]:
    """Return the parameters of ``run`` that some arguments set."""
    context = running.run.make_context("run", list(arguments))
    return {name: value for name, value in context.params.items() if value not in (None, (), False)}


def test_options_that_are_not_given_set_nothing() -> None:
    assert parsed("-o", "a.mcap") == {"output": Path("a.mcap")}
    assert parsed("--miss", "-0.25", "--bounds", "-1,2.5", "--hash", "--settle", "3") == {
        "miss": -0.25, "bounds": "-1,2.5", "hash": True, "settle": 3,
    }  # fmt: skip
    context = running.run.make_context("run", ["--no-hash", "--settle", "0"])
    given = {name: value for name, value in context.params.items() if name in PARAMETERS and value is not None}
    assert given == {"hash": False, "settle": 0}


def test_a_team_file_saved_in_another_folder_names_the_same_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "teams").mkdir()
    for name in ("a", "b", "c"):
        Path(f"{name}.mcap").write_text("")
    team = RunConfig(robots=tuple(RobotConfig(name, (Path(f"{name}.mcap"),)) for name in ("a", "b", "c")))
    team_options.save_team_file(team, Path("teams/team.yaml"))
    robots = load_team_file(tmp_path / "teams" / "team.yaml").robots
    assert [log for robot in robots for log in robot.logs] == [tmp_path.resolve() / f"{n}.mcap" for n in "abc"]


def test_a_run_prints_its_results(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    done = octoreplay("run", PAIR_TEAM, "-o", path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "agreement, worst robot" in done.stdout
    assert f"wrote {path}" in done.stdout


@pytest.mark.long
def test_compilation_is_announced_once(pair_result: Path, tmp_path: Path) -> None:
    for is_first in (True, False):
        done = octoreplay_process("query", pair_result, "--point", 1, 0, 0, NUMBA_CACHE_DIR=str(tmp_path))
        assert done.returncode == 0
        assert done.stderr.startswith("compiling kernels") == is_first
        assert done.stderr.count("\n") == is_first


def test_a_team_file_with_every_kind_of_fault(tmp_path: Path) -> None:
    (tmp_path / "team.yaml").write_text(
        PAIR_TEAM.read_text().replace("log: ", f"publish_period: 1.0, log: {PAIR}/")
        + "rule: flood\npackets: delta\ntopology: line\npublish_period: 0.5\nlatency: 0.2\njitter: 0.1\nloss: 0.2\n"
        + "links: [{from: husky_1, to: husky_2, corruption: 0.3}]\n"
        + "schedule: [{from: 1, to: 2, robots_off: [husky_2], forget: true}]\n"
    )
    done = octoreplay("run", tmp_path / "team.yaml", "-o", tmp_path / "x.mcap")
    assert done.returncode == 0, done.stderr
    with open_result(tmp_path / "x.mcap") as opened:
        assert opened.summary.last.robots[0].agreement > 0.9
        assert sum(link.num_lost for link in opened.summary.links) > 0


def test_repeated_runs_give_the_same_bytes(pair_result: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.mcap"
    done = octoreplay("run", PAIR_TEAM, "--state-every", "1", "--view-every", "2", "-o", again)
    assert done.returncode == 0, done.stderr
    assert messages(again) == messages(pair_result)
    # The metadata holds the relative paths of the logs, which are equal in the same folder only.
    repeated = tmp_path / "repeated.mcap"
    assert octoreplay("run", "--config-from", again, "-o", repeated).returncode == 0
    assert repeated.read_bytes() == again.read_bytes()


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        return [(channel.topic, m.log_time, m.data) for _, channel, m in make_reader(stream).iter_messages()]


def test_a_run_of_logs_saves_its_team_file(tmp_path: Path) -> None:
    logs = sorted(PAIR.glob("*.mcap"))
    team_file = tmp_path / "team.yaml"
    done = octoreplay("run", *logs, "--save-team", team_file, "--resolution", "0.4")
    assert done.returncode == 0, done.stderr
    assert "/husky_1/camera/depth/image_raw" in done.stdout
    assert f"saved {team_file}" in done.stdout
    config = load_team_file(team_file)
    assert config.map.resolution == 0.4
    assert [robot.robot_id for robot in config.robots] == ["husky_1", "husky_2"]
    assert all(log.samefile(original) for log, original in zip((r.logs[0] for r in config.robots), logs, strict=True))
    done = octoreplay("run", team_file, "-o", tmp_path / "out.mcap", "--settle", "0")
    assert done.returncode == 0, done.stderr


def test_a_changed_log_is_warned_of(tmp_path: Path) -> None:
    for path in PAIR.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    assert octoreplay("run", tmp_path / "team.yaml", "-o", first, "--settle", "0").returncode == 0
    other = TRIO / "husky_1.mcap"
    (tmp_path / "husky_1.mcap").write_bytes(other.read_bytes())
    done = octoreplay("run", "--config-from", first, "-o", second)
    assert "husky_1.mcap: has changed since first.mcap was made from it" in done.stderr


def test_the_first_part_of_a_cut_log_is_used(tmp_path: Path) -> None:
    for path in PAIR.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    log = tmp_path / "husky_2.mcap"
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.7)])
    done = octoreplay("run", tmp_path / "team.yaml", "-o", tmp_path / "out.mcap", "--settle", "0")
    assert done.returncode == 3, done.stderr
    assert re.search(r"warning: .*husky_2\.mcap", done.stderr)
    assert (tmp_path / "out.mcap").exists()


@long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_a_partial_result_and_the_old_result(tmp_path: Path, number: signal.Signals) -> None:
    out, partial = tmp_path / "out.mcap", tmp_path / "out.partial.mcap"
    out.write_text("the result of yesterday")
    # The ramp of gamma takes so long that the run cannot end before the signal.
    settling = ["--rule", "gradient", "--settle", "100000", "--settle-max", "100000"]
    arguments = ["run", PAIR_TEAM, "-o", out, "--force", *settling, "--state-every", "0.001"]
    with started(*arguments) as process:
        wait_for(lambda: partial.exists() and partial.stat().st_size > 20_000)
        process.send_signal(number)
        _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert f"interrupted; the finished part is in {partial}" in errors
    assert out.read_text() == "the result of yesterday"
    # From Python a KeyboardInterrupt is enough; here a signal is pending while the check point is saved.
    assert (tmp_path / "out.checkpoint").exists()
    with open_result(partial) as opened:
        assert opened.summary.stop_reason == "interrupted"
        assert len(opened.metrics) >= 1


@long
def test_a_run_of_a_part_of_the_logs(tmp_path: Path) -> None:
    done = octoreplay(
        "run", PAIR_TEAM, "-o", tmp_path / "a.mcap", "--settle", "0", "--start", "1", "--duration", "2", "--every", "2"
    )
    assert done.returncode == 0
    with open_result(tmp_path / "a.mcap") as result:
        # Every second image of 2 s at 4 Hz, of both robots.
        assert [counts.used for counts in result.summary.frame_counts.values()] == [4, 4]
        assert len(result.metrics) == 3
    assert_fails(
        2, "hide_robots: no robot has a body_box", "run", PAIR_TEAM, "-o", tmp_path / "b.mcap", "--hide-robots"
    )
    assert_fails(
        1, "no robot has a frame that can be used", "run", PAIR_TEAM, "-o", tmp_path / "b.mcap", "--start", "99"
    )
