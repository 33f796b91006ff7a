"""The command line, most of it run as a process on the small recorded teams."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader
from plyfile import PlyData

from octoreplay import __version__, cli
from octoreplay.commands import running, team_options
from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.config import presets
from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError
from octoreplay.result import open_result

FIXTURES = Path(__file__).parent / "fixtures"
PAIR = FIXTURES / "pair" / "team.yaml"
COMMANDS = (
    "run", "simulate", "demo", "export", "metrics", "info", "init", "query", "import-rgbd", "import-clouds",
    "evaluate", "check", "compare", "sweep", "experiment",
)  # fmt: skip


def octoreplay(*arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command line as a process, 100 columns wide."""
    return subprocess.run(
        [sys.executable, "-m", "octoreplay", *map(str, arguments)], cwd=folder, text=True, capture_output=True,
        env={**os.environ, "COLUMNS": "100", "PYTHONIOENCODING": "utf-8"}, check=False, timeout=300,
    )  # fmt: skip


def fails(code: int, sentence: str, *arguments: object) -> None:
    """A command ends with this code and one sentence on stderr, without a traceback."""
    done = octoreplay(*arguments)
    assert done.returncode == code, done.stderr
    assert re.search(sentence, done.stderr), done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of the two robots' team."""
    path = tmp_path_factory.mktemp("run") / "result.mcap"
    done = octoreplay("run", PAIR, "-o", path, "--state-every", "1", "--view-every", "2")
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"(compiling kernels [^\n]*\n)?", done.stderr)
    assert "agreement, worst robot" in done.stdout
    assert f"wrote {path}" in done.stdout
    return path


def test_compiling_is_said_once(result: Path, tmp_path: Path) -> None:
    for said in (True, False):
        done = subprocess.run(
            [sys.executable, "-m", "octoreplay", "query", str(result), "--at", "1", "0", "0"], text=True,
            capture_output=True, env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}, check=True, timeout=300,
        )  # fmt: skip
        assert done.stderr.startswith("compiling kernels") == said
        assert done.stderr.count("\n") == said


# --- options ----------------------------------------------------------------------------------------------------------


def test_help_and_version_are_there_for_everything() -> None:
    for arguments in ([], *([command] for command in COMMANDS)):
        done = octoreplay(*arguments, "--help")
        assert done.returncode == 0
        assert "Usage: octoreplay" in done.stdout
    assert octoreplay("--version").stdout == f"octoreplay, version {__version__}\n"


def test_help_imports_nothing_heavy() -> None:
    heavy = ("numba", "scipy", "matplotlib", "open3d", "rosbags", "mcap", "rich", "networkx")
    code = (
        "import sys; from octoreplay.cli import cli\n"
        "try: cli.main(['run', '--help'], standalone_mode=False)\n"
        f"finally: print('loaded', [name for name in {heavy!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, check=True)
    assert done.stdout.endswith("loaded []\n")


def test_every_parameter_is_an_option_of_run_by_its_name() -> None:
    names = {name: option for option in running.run.params for name in option.opts}
    for name, parameter in PARAMETERS.items():
        option = names[f"--{name.replace('_', '-')}"]
        assert option.name == name
        assert parameter.help in (option.help or "")


def parsed(*arguments: str) -> dict[str, object]:
    """What ``run`` would hand on from some arguments: only what was given."""
    context = running.run.make_context("run", list(arguments))
    return {name: value for name, value in context.params.items() if value is not None and value != ()}


def test_only_what_is_given_counts() -> None:
    assert parsed("-o", "a.mcap") == {"output": Path("a.mcap")}
    assert parsed("--miss", "-0.25", "--bounds", "-1,2.5", "--no-hash", "--settle", "0") == {
        "miss": -0.25, "bounds": "-1,2.5", "hash": False, "settle": 0,
    }  # fmt: skip


def base() -> RunConfig:
    return RunConfig(robots=tuple(RobotConfig(name, (Path(f"{name}.mcap"),)) for name in ("a", "b", "c")))


def test_options_beat_the_preset_and_the_preset_beats_the_file() -> None:
    file = base().with_parameters({"evidence": "cell-average", "gamma": 0.125, "hit": 2.0})
    config = presets.with_options(file, "paper", None, {"gamma": 0.75})
    assert config.consensus.evidence == "time-average"
    assert config.consensus.gamma == 0.75
    assert config.sensor.hit == 2.0
    assert presets.with_options(file, None, None, {}) == file


def test_edges_set_the_topology_and_the_weights() -> None:
    config = presets.with_options(base(), None, "a:b, b:c", {})
    assert (config.network.topology, config.network.weights) == ("edges", "metropolis")
    assert config.network.edges == (("a", "b", None), ("b", "c", None))
    weighted = presets.with_options(base(), None, "a:b:0.25,b:c:0.5", {"epsilon": 0.1})
    assert (weighted.network.weights, weighted.network.edges[1]) == ("given", ("b", "c", 0.5))
    back = presets.with_options(weighted, None, None, {"topology": "ring"})
    assert (back.network.topology, back.network.weights, back.network.edges) == ("ring", "metropolis", ())
    kept = presets.with_options(weighted, None, None, {"hit": 2.0})
    assert kept.network == weighted.network


@pytest.mark.parametrize(
    ("edges", "sentence"),
    [("a", "'a' is not A:B or A:B:WEIGHT"), ("a:b:c:d", "is not A:B"), ("a:b:x", "the weight in 'a:b:x' is not a"),
     ("a:z", "robot 'z' is not in the team"), ("a:a", "cannot have a link to itself"), ("a::1", "is not A:B")],
)  # fmt: skip
def test_bad_edges_are_one_sentence(edges: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        presets.with_options(base(), None, edges, {})


def test_a_saved_team_file_holds_wherever_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "teams").mkdir()
    for name in ("a", "b", "c"):
        Path(f"{name}.mcap").write_text("")
    team_options.save_team_file(base(), Path("teams/team.yaml"))
    robots = load_team_file(tmp_path / "teams" / "team.yaml").robots
    assert [log for robot in robots for log in robot.logs] == [tmp_path.resolve() / f"{n}.mcap" for n in "abc"]


# --- bad usage --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["run", "-o", "x.mcap"], 2, "give a team file or logs"),
        (["run", PAIR], 2, "give the result's name: -o OUT.mcap"),
        (["run", PAIR, PAIR, "-o", "x.mcap"], 2, "give one team file, or logs, not both"),
        (["run", PAIR, "-o", "x.mcap", "--config-from", "y.mcap"], 2, "--config-from y.mcap names the logs too"),
        (["run", "none.yaml", "-o", "x.mcap"], 2, r"none\.yaml: cannot be read: No such file"),
        (["run", "none.mcap", "-o", "x.mcap"], 1, r"none\.mcap"),
        (["run", PAIR, "-o", "x.mcap", "--rule", "magic"], 2, "'magic' is not one of"),
        (["run", PAIR, "-o", "x.mcap", "--hit", "-1"], 2, "hit: -1.0 must be greater than 0"),
        (["run", PAIR, "-o", "x.mcap", "--bounds", "1"], 2, "bounds: expects 2 or 6 numbers, got 1"),
        (["run", PAIR, "-o", "x.mcap", "--bounds", "nan,5"], 2, "bounds: expects finite numbers"),
        (["run", PAIR, "-o", "x.mcap", "--publish-period", "1e-7"], 2, "more than 10,000,000; check clock_offset"),
        (["run", PAIR, "-o", "x.yaml"], 2, r"x\.yaml: the output's name must end in \.mcap"),
        (["run", PAIR, "--save-team", PAIR], 1, "is an input of this command"),
        (["query", PAIR, "--box", "5", "5", "5", "0", "0", "0"], 2, "box: every minimum must be below its maximum"),
        (["query", PAIR, "--at", "nan", "0", "0"], 2, "at: expects finite numbers"),
        (["run", PAIR, "-o", "x.mcap", "--resolution", "small"], 2, "'small' is not a valid float"),
        (["run", "--config-from", PAIR, "-o", "x.mcap"], 1, "not a finished MCAP file"),
        (["info"], 2, "Missing argument"),
        (["info", "none.mcap"], 1, r"none\.mcap"),
        (["metrics", "none.mcap"], 1, r"none\.mcap: cannot be read"),
        (["metrics", FIXTURES / "pair" / "husky_1.mcap"], 1, "no result of octoreplay"),
        (["query", "none.mcap"], 2, "ask for a point, --at X Y Z, or a box"),
        (["simulate", "x", "--image", "big"], 2, "image: expects WIDTHxHEIGHT such as 160x120, got 'big'"),
        (["simulate", "x", "--robots", "0"], 2, "num_robots: 0 is not between 1 and 100"),
        (["fly"], 2, "No such command 'fly'"),
    ],
)
def test_bad_usage_is_one_sentence_and_a_code(
    arguments: list[object], code: int, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert cli._exit_code([str(argument) for argument in arguments]) == code
    captured = capsys.readouterr()
    assert re.search(sentence, captured.err), captured.err
    assert list(tmp_path.iterdir()) == []


HUSKIES = "husky_1:husky_2"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--one-way", "husky_1:spot"], "one_way: robot 'spot' is not in the team: husky_1, husky_2"),
        (["--one-way", "husky_1"], "one_way: 'husky_1' is not A:B"),
        (["--one-way", f"{HUSKIES}:0.5"], "one_way: 'husky_1:husky_2:0.5' is not A:B"),
        (["--edges", f"{HUSKIES}:-0.5"], "edges: the weight of husky_1 - husky_2 must be a finite number from 0 on"),
        (["--edges", f"{HUSKIES}:1.5"], "edges: the weights of robot 'husky_1' sum to 1.5; lower them to at most 1"),
        (["--epsilon", "1.5"], r"epsilon: 1.5 is not below 1, the bound of this .*; use 0.9 or leave epsilon out"),
        (["--jitter", "0.5", "--latency", "0.2"], "jitter: 0.5 is above latency 0.2; a delay cannot be negative"),
        (["--budget", "5000"], "budget: goes with packets 'delta'; a whole map cannot be sent in parts"),
        (["--budget", "5000", "--packets", "delta", "--no-acknowledge"], "budget: goes with acknowledge"),
        (["--budget", "300", "--packets", "delta"], r"budget: 300 bytes may not hold one brick .* give at least \d+"),
        (["--rule", "ratio", "--content", "int8"], "rule: 'ratio' sends running sums.* use packets 'full', content"),
        (["--rule", "ratio", "--packets", "delta"], "rule: 'ratio' sends running sums.* use packets 'full', content"),
        (["--rule", "flood", "--mode", "on-arrival"], "mode: rule 'flood' adds up .* use mode 'sync'"),
        (["--rule", "flood", "--preset", "paper"], "mode: rule 'flood' adds up .* use mode 'sync'"),
        (["--top-classes", "0"], "top_classes: 0 is below the least value 1"),
        (["--loss", "1.5"], "loss: 1.5 is above the largest value 1"),
        (["--corruption", "-0.1"], "corruption: -0.1 is below the least value 0"),
        (["--burst-start", "nan"], "burst_start: nan is not a finite number"),
        (["--start", "1e300"], r"start: 1e\+300 is above the largest value 1e\+12"),
        (["--pose-gap", "1e13"], r"pose_gap: 1e\+13 is above the largest value 1e\+12"),
        (["--rate", "1e-300"], "rate: 1e-300 is below the least value 1e-15"),
        (["--publish-period", "1e6"], r"publish_period: 1000000\.0 is above the largest value 86400"),
        (["--schedule", "none.yaml"], r"none\.yaml: cannot be read: No such file"),
        (["--schedule", FIXTURES], "fixtures: cannot be read: Is a directory"),
        (["--schedule", FIXTURES / "pair" / "husky_1.mcap"], r"husky_1\.mcap: not a schedule file \(no UTF-8 text\)"),
        (["--schedule", PAIR], r"team\.yaml: schedule: expects a list of entries, each with 'from'"),
    ],
)  # fmt: skip
def test_what_the_network_cannot_do_is_one_sentence_and_nothing_is_written(
    arguments: list[object], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert cli._exit_code([str(a) for a in ("run", PAIR, "-o", "x.mcap", *arguments)]) == 2
    captured = capsys.readouterr()
    assert re.search(sentence, captured.err), captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        ("- {from: 1, to: 5, robots_off: [husky_1]}\n- {from: 3, robots_off: [husky_1]}",
         r"robot 'husky_1' is in it twice at 3 s \(from 1 s to 5 s, and from 3 s on\); end the one before"),
        ("- {from: 1, links_down: [[husky_1, husky_2]], links_up: [[husky_2, husky_1]]}", "is in it twice at 1 s"),
        ("- {from: 1}", "the entry from 1 s on says nothing; give it groups, links_down"),
        ("- {from: 1, robots_off: [spot]}", "schedule: robot 'spot' is not in the team: husky_1, husky_2"),
        ("- {from: 1, robot_off: [husky_1]}", r"schedule\.yaml: schedule: robot_off: unknown key; did you mean"),
        ("- {from: 1\n", r"schedule\.yaml: not valid YAML \(line 2\)"), ("", "expects a list of entries"),
        ("- {from: 5, to: 1, robots_off: [husky_1]}", "from 5 s to 1 s; 'from' must be first"),
    ],
)  # fmt: skip
def test_a_bad_schedule_is_one_sentence_and_nothing_is_written(
    entries: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "schedule.yaml"
    path.write_text(entries)
    arguments = ["run", str(PAIR), "-o", str(tmp_path / "x.mcap"), "--schedule", str(path)]
    assert cli._exit_code(arguments) == 2
    captured = capsys.readouterr()
    assert re.search(sentence, captured.err), captured.err
    assert captured.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == [path]


def test_a_step_beyond_the_bound_of_a_graph_of_the_schedule_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three robots that all hear each other stand steps up to 2/3; the line that is left of them up to 1/2."""
    path = tmp_path / "schedule.yaml"
    path.write_text("- {from: 2, links_down: [[husky_1, husky_3]]}")
    team = FIXTURES / "trio" / "team.yaml"
    arguments = ["run", str(team), "-o", str(tmp_path / "x.mcap"), "--weights", "degree"]
    arguments += ["--epsilon", "0.6", "--schedule", str(path)]
    assert cli._exit_code(arguments) == 2
    captured = capsys.readouterr()
    assert re.search(r"schedule: at 2 s: epsilon: 0\.6 is not below 0\.5,.*; use 0\.45 or leave", captured.err), (
        captured.err
    )
    assert list(tmp_path.iterdir()) == [path]


def test_a_team_file_with_every_kind_of_fault_runs(tmp_path: Path) -> None:
    (tmp_path / "team.yaml").write_text(
        PAIR.read_text().replace("log: ", f"publish_period: 1.0, log: {PAIR.parent}/")
        + "rule: flood\npackets: delta\ntopology: line\npublish_period: 0.5\nlatency: 0.2\njitter: 0.1\nloss: 0.2\n"
        + "links: [{from: husky_1, to: husky_2, corruption: 0.3}]\n"
        + "schedule: [{from: 1, to: 2, robots_off: [husky_2], forget: true}]\n"
    )
    done = octoreplay("run", tmp_path / "team.yaml", "-o", tmp_path / "x.mcap")
    assert done.returncode == 0, done.stderr
    with open_result(tmp_path / "x.mcap") as opened:
        assert opened.summary.last.robots[0].agreement > 0.9
        assert sum(link.num_lost for link in opened.summary.links) > 0


# --- the whole way ----------------------------------------------------------------------------------------------------


def test_the_same_command_gives_the_same_bytes_and_config_from_repeats_it(result: Path, tmp_path: Path) -> None:
    for arguments in ((PAIR, "--state-every", "1", "--view-every", "2"), ("--config-from", result)):
        again = tmp_path / "again.mcap"
        done = octoreplay("run", *arguments, "-o", again)
        assert done.returncode == 0, done.stderr
        assert messages(again) == messages(result)
    # In the same folder, where the logs have the same relative names, even the metadata is equal.
    twin = result.with_name("twin.mcap")
    assert octoreplay("run", "--config-from", result, "-o", twin).returncode == 0
    assert twin.read_bytes() == result.read_bytes()


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        return [(channel.topic, m.log_time, m.data) for _, channel, m in make_reader(stream).iter_messages()]


def test_logs_alone_are_enough_and_what_was_found_can_be_saved(tmp_path: Path) -> None:
    logs = sorted((FIXTURES / "pair").glob("*.mcap"))
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
    for path in (FIXTURES / "pair").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    assert octoreplay("run", tmp_path / "team.yaml", "-o", first, "--settle", "0").returncode == 0
    other = FIXTURES / "trio" / "husky_1.mcap"
    (tmp_path / "husky_1.mcap").write_bytes(other.read_bytes())
    done = octoreplay("run", "--config-from", first, "-o", second)
    assert "husky_1.mcap: has changed since first.mcap was made from it" in done.stderr


def test_a_cut_log_is_used_as_far_as_it_goes(tmp_path: Path) -> None:
    for path in (FIXTURES / "pair").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    log = tmp_path / "husky_2.mcap"
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.7)])
    done = octoreplay("run", tmp_path / "team.yaml", "-o", tmp_path / "out.mcap", "--settle", "0")
    assert done.returncode == 3, done.stderr
    assert re.search(r"warning: .*husky_2\.mcap", done.stderr)
    assert (tmp_path / "out.mcap").exists()


def test_metrics_shows_the_table_and_writes_csv_and_figures(result: Path, tmp_path: Path) -> None:
    done = octoreplay("metrics", result, "--csv", tmp_path / "m.csv", "--plot", tmp_path / "figures")
    assert done.returncode == 0, done.stderr
    assert "agreement, worst robot" in done.stdout
    assert "wall time" not in done.stdout
    with open_result(result) as opened:
        assert len((tmp_path / "m.csv").read_text().splitlines()) == len(opened.metrics) + 1
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == ["disagreement.png", "packet_size.png"]


def test_export_writes_what_it_says(result: Path, tmp_path: Path) -> None:
    done = octoreplay("export", result, "-o", tmp_path / "map.ply", "--what", "voxels", "--robot", "husky_2")
    assert done.returncode == 0, done.stderr
    count = int(re.search(r"\(([\d,]+) cubes", done.stdout)[1].replace(",", ""))
    data = PlyData.read(tmp_path / "map.ply")
    assert (data["vertex"].count, data["face"].count) == (8 * count, 12 * count)
    assert "octoreplay map of husky_2" in data.comments[0]
    fails(1, "robot 'husky_9' not found; robots: husky_1, husky_2", "export", result, "-o", tmp_path / "x.ply",
          "--robot", "husky_9")  # fmt: skip
    fails(2, r"out\.mcap: the output's name must end in \.ply", "export", result, "-o", tmp_path / "out.mcap")
    fails(1, "is a folder or a device", "export", result, "-o", "/dev/full")
    fails(1, "no map of robot 'husky_1' is stored up to", "export", result, "-o", tmp_path / "x.ply", "--at", "-5")
    fails(1, r"none/x\.ply: cannot be written", "export", result, "-o", tmp_path / "none" / "x.ply")
    assert not (tmp_path / "x.ply").exists()


def test_query_tells_what_is_where(result: Path) -> None:
    with open_result(result) as opened:
        stored = opened.map("husky_1")
        leaves = stored.leaves()
        index = int(leaves.log_odds.max(axis=1).argmax())
        x, y, z = leaves.centers[index]
        name = opened.class_table.names[int(leaves.log_odds[index].argmax())]
    done = octoreplay("query", result, "--at", x, y, z, "--at", 1e6, 0, 0, "--box", *(-100.0,) * 3, *(100.0,) * 3)
    assert done.returncode == 0, done.stderr
    assert re.search(rf"{name} +\d+\.\d\d %", done.stdout)
    assert re.search(r"1e\+06, 0, 0 +unknown", done.stdout)
    assert "m\u00b3" in done.stdout


def test_info_describes_logs() -> None:
    done = octoreplay("info", *sorted((FIXTURES / "trio").glob("*.mcap")))
    assert done.returncode == 0, done.stderr
    assert "/husky_3/camera/depth/image_raw" in done.stdout
    assert "nothing is missing for a run" in done.stdout
    assert max(len(line) for line in done.stdout.splitlines()) <= 100


def interrupted(
    arguments: list[object], ready: Callable[[], bool], number: signal.Signals
) -> subprocess.CompletedProcess[str]:
    """A command that gets a signal once it is ready."""
    process = subprocess.Popen(
        [sys.executable, "-m", "octoreplay", *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    while process.poll() is None and not ready():
        time.sleep(0.02)
    process.send_signal(number)
    out, err = process.communicate(timeout=120)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_a_partial_result_and_the_old_one(tmp_path: Path, number: signal.Signals) -> None:
    out, partial = tmp_path / "out.mcap", tmp_path / "out.partial.mcap"
    out.write_text("the result of yesterday")
    # Very long settling, so that the run is still going when the signal comes.
    arguments = ["run", PAIR, "-o", out, "--settle", "100000", "--settle-max", "100000", "--state-every", "0.001"]
    done = interrupted(arguments, lambda: partial.exists() and partial.stat().st_size > 20_000, number)
    assert done.returncode == 130, done.stderr
    assert f"interrupted; what was finished is in {partial}" in done.stderr
    assert out.read_text() == "the result of yesterday"
    with open_result(partial) as opened:
        assert opened.summary.stop_reason == "interrupted"
        assert len(opened.metrics) >= 1


def test_demo_makes_everything_and_says_so(tmp_path: Path) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    done = octoreplay("demo", "show", "--robots", 2, "--duration", 3, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    for name in (
        "logs/team.yaml",
        "logs/world.ply",
        "result.mcap",
        "map.ply",
        "metrics.csv",
        "figures/disagreement.png",
    ):
        assert (tmp_path / "show" / name).exists()
        assert (tmp_path / "show" / name).stat().st_size > 0
    assert "Foxglove" in done.stdout
    fails(1, "show.*logs: is not empty; give a new folder", "demo", tmp_path / "show")


# --- folders of clouds ------------------------------------------------------------------------------------------------


def save_wall(path: Path, viewpoint: str, *, extra: str = "") -> None:
    """A PCD file of a wall of label 7 at x = 2, in the world's frame, seen from somewhere."""
    rows = [f"2.05 {y / 20} {z / 20} 7{extra}" for y in range(-20, 20) for z in range(20)]
    path.write_text(
        f"FIELDS x y z label\nSIZE 4 4 4 4\nTYPE F F F U\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\n"
        "DATA ascii\n" + "\n".join(rows)
    )


@pytest.fixture
def walls(tmp_path: Path) -> Path:
    """Three clouds of one wall, and a team file that names its label."""
    (tmp_path / "in").mkdir()
    for index, viewpoint in enumerate(("0 0 0.5 1 0 0 0", "0.5 0.25 0.5 0.8 0 0 0.6", "-0.5 0 0.5 0.6 0 0 -0.8")):
        save_wall(tmp_path / "in" / f"{index}.pcd", viewpoint)
    (tmp_path / "team.yaml").write_text(
        "robots: [{id: a, log: a.mcap}]\nclasses: [{name: wall, raw_labels: [7]}, {name: floor, raw_labels: [8]}]\n"
    )
    return tmp_path / "in"


def test_a_folder_of_clouds_becomes_a_log_that_maps(walls: Path, tmp_path: Path) -> None:
    log, out = tmp_path / "a.mcap", tmp_path / "out.mcap"
    done = octoreplay("import-clouds", walls, "-o", log, "--rate", 10, "--classes-from", tmp_path / "team.yaml")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == (
        f"wrote {log} (PCD: robot a, 3 clouds, 3 with labels, 0.2 s;"
        " poses from VIEWPOINT, points in the world's frame)\n"
    )
    done = octoreplay("run", log, "-o", out, "--resolution", "0.1")
    assert done.returncode == 0, done.stderr
    # However the sensor stood and turned, the wall is where it is, and before it is nothing.
    done = octoreplay("query", out, "--at", 2.05, 0.05, 0.55, "--at", 1.5, 0.05, 0.55)
    assert re.search(r"2\.05, 0\.05, 0\.55 +wall", done.stdout), done.stdout
    assert re.search(r"1\.5, 0\.05, 0\.55 +free", done.stdout), done.stdout


def test_clouds_that_are_left_out_or_odd_are_said(walls: Path, tmp_path: Path) -> None:
    save_wall(walls / "1.pcd", "0 0 0 0 0 0 0", extra=" -1")
    save_wall(walls / "2.pcd", "0 0 1 1 0 0 0", extra=" -1")
    done = octoreplay("import-clouds", walls, "-o", tmp_path / "a.mcap", "--rate", 10)
    assert done.returncode == EXIT_DATA_LOST
    assert "2 clouds, 2 with labels" in done.stdout
    odd, left_out = done.stderr.splitlines()
    assert odd.startswith(f"warning: {walls / '2.pcd'}: rows have more columns than the header names; those after")
    assert left_out == "warning: 1 clouds without a usable pose were left out"


def test_clouds_that_cannot_become_a_log_are_one_sentence(walls: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    fails(2, r"in: the frames have no times; give a rate or a file of times", "import-clouds", walls, "-o", out)
    fails(2, r"a\.bag: the output's name must end in \.mcap", "import-clouds", walls, "-o", tmp_path / "a.bag")
    (walls / "1.pcd").write_bytes((walls / "1.pcd").read_bytes()[:-30])
    sentence = r"1\.pcd: is cut or damaged: .*; fetch it again or remove it"
    fails(1, sentence, "import-clouds", walls, "-o", out, "--rate", 10)
    assert not out.exists()


def test_init_writes_a_team_file_that_runs(tmp_path: Path) -> None:
    logs = sorted((FIXTURES / "pair").glob("*.mcap"))
    team_file = tmp_path / "team.yaml"
    done = octoreplay("init", *logs, "-o", team_file)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"wrote {team_file} (2 robots)\n", "")
    assert load_team_file(team_file).robots[0].pose_topic == "/husky_1/odom"
    fails(
        1, f"error: {team_file}: is there already; name another file, or give --force", "init", *logs, "-o", team_file
    )
    assert octoreplay("init", *logs, "-o", team_file, "--force").returncode == 0
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    assert octoreplay("run", team_file, "-o", first, "--settle", "0").returncode == 0
    assert octoreplay("run", *logs, "-o", second, "--settle", "0").returncode == 0
    with open_result(first) as one, open_result(second) as other:
        for robot in one.robots:
            assert (one.map(robot).leaves().log_odds == other.map(robot).leaves().log_odds).all()


def test_init_says_what_is_missing_and_writes_it_down(tmp_path: Path) -> None:
    team_file = tmp_path / "team.yaml"
    done = octoreplay("init", FIXTURES / "containers" / "foxglove_json.mcap", "-o", team_file)
    assert done.returncode == 0
    assert "missing for a run: labels on " in done.stderr
    (tmp_path / "empty.bag").touch()
    fails(1, "the file is empty", "init", tmp_path / "empty.bag", "-o", tmp_path / "x.yaml")
    assert not (tmp_path / "x.yaml").exists()


def test_info_goes_on_after_a_log_that_cannot_be_opened(tmp_path: Path) -> None:
    done = octoreplay("info", tmp_path / "none.mcap", FIXTURES / "containers" / "lz4.bag")
    assert done.returncode == 1
    assert f"error: {tmp_path / 'none.mcap'}: no such file" in done.stderr
    assert "/camera/depth/image_raw" in done.stdout


def test_a_part_of_the_logs_can_be_taken(tmp_path: Path) -> None:
    done = octoreplay(
        "run", PAIR, "-o", tmp_path / "a.mcap", "--settle", "0", "--start", "1", "--duration", "2", "--every", "2"
    )
    assert done.returncode == 0
    with open_result(tmp_path / "a.mcap") as result:
        # 4 Hz for 2 s, every other one, of both robots.
        assert [counts.used for counts in result.summary.frame_counts.values()] == [4, 4]
        assert len(result.metrics) == 3
    fails(2, "hide_robots: no robot has a body_box", "run", PAIR, "-o", tmp_path / "b.mcap", "--hide-robots")
    fails(1, "no robot has a frame that can be used", "run", PAIR, "-o", tmp_path / "b.mcap", "--start", "99")
