"""Tests of the command line, most of them run as processes on the fixture teams."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from octoreplay import __version__, cli
from octoreplay.commands import running, team_options
from octoreplay.config import presets
from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError
from support.processes import octoreplay

FIXTURES = Path(__file__).parent / "fixtures"
PAIR = FIXTURES / "pair" / "team.yaml"
COMMANDS = (
    "run", "simulate", "demo", "export", "metrics", "info", "init", "query", "import-rgbd", "import-clouds",
    "evaluate", "check", "compare", "sweep", "experiment",
)  # fmt: skip


# --- options ----------------------------------------------------------------------------------------------------------


def test_every_command_has_help() -> None:
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
    """Values of the options given in the arguments of ``run``."""
    context = running.run.make_context("run", list(arguments))
    return {name: value for name, value in context.params.items() if value is not None and value != ()}


def test_options_that_are_not_given_have_no_value() -> None:
    assert parsed("-o", "a.mcap") == {"output": Path("a.mcap")}
    assert parsed("--miss", "-0.25", "--bounds", "-1,2.5", "--no-hash", "--settle", "0") == {
        "miss": -0.25, "bounds": "-1,2.5", "hash": False, "settle": 0,
    }  # fmt: skip


def base() -> RunConfig:
    return RunConfig(robots=tuple(RobotConfig(name, (Path(f"{name}.mcap"),)) for name in ("a", "b", "c")))


def test_options_override_the_preset_and_the_preset_overrides_the_file() -> None:
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
def test_bad_edges_are_reported_in_one_sentence(edges: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        presets.with_options(base(), None, edges, {})


def test_a_saved_team_file_has_absolute_log_paths_outside_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
        (["run", "-o", "x.mcap"], 2, "name a team file or logs"),
        (["run", PAIR], 2, "name the result with -o OUT.mcap"),
        (["run", PAIR, PAIR, "-o", "x.mcap"], 2, "name one team file or several logs, not both"),
        (["run", PAIR, "-o", "x.mcap", "--config-from", "y.mcap"], 2, "--config-from y.mcap also sets the logs"),
        (["run", "none.yaml", "-o", "x.mcap"], 2, r"none\.yaml: cannot be read: No such file"),
        (["run", "none.mcap", "-o", "x.mcap"], 1, r"none\.mcap"),
        (["run", PAIR, "-o", "x.mcap", "--rule", "magic"], 2, "'magic' is not one of"),
        (["run", PAIR, "-o", "x.mcap", "--hit", "-1"], 2, "hit: -1.0 must be greater than 0"),
        (["run", PAIR, "-o", "x.mcap", "--bounds", "1"], 2, "bounds: expects 2 or 6 numbers, got 1"),
        (["run", PAIR, "-o", "x.mcap", "--bounds", "nan,5"], 2, "bounds: expects finite numbers"),
        (["run", PAIR, "-o", "x.mcap", "--publish-period", "1e-7"], 2, "more than 10,000,000; check clock_offset"),
        (["run", PAIR, "-o", "x.yaml"], 2, r"x\.yaml: the name of the output must end in \.mcap"),
        (["run", PAIR, "--save-team", PAIR], 1, "is an input of this command"),
        (["query", PAIR, "--box", "5", "5", "5", "0", "0", "0"], 2, "box: every minimum must be below its maximum"),
        (["query", PAIR, "--at", "nan", "0", "0"], 2, "at: expects finite numbers"),
        (["run", PAIR, "-o", "x.mcap", "--resolution", "small"], 2, "'small' is not a valid float"),
        (["run", "--config-from", PAIR, "-o", "x.mcap"], 1, "not a finished MCAP file"),
        (["info"], 2, "Missing argument"),
        (["info", "none.mcap"], 1, r"none\.mcap"),
        (["metrics", "none.mcap"], 1, r"none\.mcap: cannot be read"),
        (["metrics", FIXTURES / "pair" / "husky_1.mcap"], 1, "no result of octoreplay"),
        (["query", "none.mcap"], 2, "name a point with --at X Y Z, or a box"),
        (["simulate", "x", "--image", "big"], 2, "image: expects WIDTHxHEIGHT such as 160x120, got 'big'"),
        (["simulate", "x", "--robots", "0"], 2, "num_robots: 0 is not between 1 and 100"),
        (["fly"], 2, "No such command 'fly'"),
    ],
)
def test_bad_usage_gives_one_sentence_and_an_exit_code(
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
        (["--edges", f"{HUSKIES}:-0.5"], "edges: the weight of husky_1 - husky_2 must be finite and at least 0"),
        (["--edges", f"{HUSKIES}:1.5"], "edges: the weights of robot 'husky_1' sum to 1.5; lower them to at most 1"),
        (["--epsilon", "1.5"], r"epsilon: 1.5 is not below 1, the bound of this .*; use 0.9 or leave epsilon out"),
        (["--jitter", "0.5", "--latency", "0.2"], "jitter: 0.5 is above latency 0.2; a delay cannot be negative"),
        (["--budget", "5000"], "budget: goes with packets 'delta'; a whole map cannot be sent in parts"),
        (["--budget", "5000", "--packets", "delta", "--no-acknowledge"], "budget: goes with acknowledge"),
        (["--budget", "300", "--packets", "delta"], r"budget: 300 bytes may not hold one brick .* give at least \d+"),
        (["--rule", "ratio", "--content", "int8"], "rule: 'ratio' sends running sums.* use packets 'full', content"),
        (["--rule", "ratio", "--packets", "delta"], "rule: 'ratio' sends running sums.* use packets 'full', content"),
        (["--rule", "flood", "--mode", "on-arrival"], "mode: rule 'flood' does not support 'on-arrival'; use 'sync'"),
        (["--rule", "flood", "--preset", "paper"], "mode: rule 'flood' does not support 'on-arrival'; use 'sync'"),
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
        (["--schedule", FIXTURES / "pair" / "husky_1.mcap"], r"husky_1\.mcap: not a schedule file: its text is"),
        (["--schedule", PAIR], r"team\.yaml: schedule: expects a list of entries, each with 'from'"),
    ],
)  # fmt: skip
def test_invalid_network_options_give_one_sentence_and_write_nothing(
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
         r"robot 'husky_1' is in two entries at 3 s \(from 1 s to 5 s, and from 3 s on\); end one before"),
        ("- {from: 1, links_down: [[husky_1, husky_2]], links_up: [[husky_2, husky_1]]}", "is in two entries at 1 s"),
        ("- {from: 1}", "the entry from 1 s on has no effect; give it groups, links_down"),
        ("- {from: 1, robots_off: [spot]}", "schedule: robot 'spot' is not in the team: husky_1, husky_2"),
        ("- {from: 1, robot_off: [husky_1]}", r"schedule\.yaml: schedule: robot_off: unknown key; did you mean"),
        ("- {from: 1\n", r"schedule\.yaml: not valid YAML \(line 2\)"), ("", "expects a list of entries"),
        ("- {from: 5, to: 1, robots_off: [husky_1]}", "from 5 s to 1 s; 'from' must be first"),
    ],
)  # fmt: skip
def test_a_bad_schedule_gives_one_sentence_and_writes_nothing(
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


def test_a_step_size_above_the_bound_of_a_scheduled_graph_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The bound is 2/3 for three robots with all links, and 1/2 for the line that the schedule leaves."""
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
