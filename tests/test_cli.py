"""The command line as a whole: help, wrong usage and exit codes."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from octoreplay import __version__
from octoreplay.config.parameters import PARAMETERS
from support.command_line import octoreplay, octoreplay_process
from support.fixture_paths import PAIR, PAIR_TEAM

COMMANDS = (
    "run", "recover", "report", "view", "plot", "foxglove-layout", "rviz-config", "rerun",
    "align", "refine", "odometry", "simulate", "demo", "export", "metrics", "info", "init", "label", "query",
    "import-rgbd", "import-clouds", "dataset", "evaluate", "check", "compare", "sweep", "experiment", "completion",
)  # fmt: skip


def test_the_help_lists_every_command() -> None:
    done = octoreplay("--help")
    assert done.returncode == 0
    assert set(re.findall(r"^  ([a-z-]+) ", done.stdout.partition("Commands:")[2], re.M)) == set(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_help(command: str) -> None:
    done = octoreplay(command, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert f"Usage: octoreplay {command} " in done.stdout


def test_the_process_prints_its_version_and_ends_with_the_exit_code() -> None:
    assert octoreplay_process("--version").stdout == f"octoreplay, version {__version__}\n"
    done = octoreplay_process("fly")
    assert done.returncode == 2
    assert "No such command 'fly'" in done.stderr


def test_help_imports_nothing_heavy() -> None:
    heavy = ("numba", "scipy", "matplotlib", "open3d", "rosbags", "mcap", "rich", "networkx")
    code = (
        "import sys; from octoreplay.cli import cli\n"
        "try: cli.main(['run', '--help'], standalone_mode=False)\n"
        f"finally: print('loaded', [name for name in {heavy!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, check=True)
    assert done.stdout.endswith("loaded []\n")


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["run", "-o", "x.mcap"], 2, "name a team file or logs"),
        (["run", PAIR_TEAM], 2, "name the result with -o OUT.mcap"),
        (["run", PAIR_TEAM, PAIR_TEAM, "-o", "x.mcap"], 2, "name one team file or several logs, not both"),
        (["run", PAIR_TEAM, "-o", "x.mcap", "--config-from", "y.mcap"], 2, "--config-from y.mcap also sets the logs"),
        (["run", "none.yaml", "-o", "x.mcap"], 2, r"none\.yaml: cannot be read: No such file"),
        (["run", "none.mcap", "-o", "x.mcap"], 1, r"none\.mcap"),
        (["run", PAIR_TEAM, "-o", "x.mcap", "--rule", "magic"], 2, "'magic' is not one of"),
        (["run", PAIR_TEAM, "-o", "x.mcap", "--hit", "-1"], 2, "hit: -1.0 must be greater than 0"),
        (["run", PAIR_TEAM, "-o", "x.mcap", "--bounds", "1"], 2, "bounds: expects 2 or 6 numbers, got 1"),
        (["run", PAIR_TEAM, "-o", "x.mcap", "--bounds", "nan,5"], 2, "bounds: expects finite numbers"),
        (["run", PAIR_TEAM, "-o", "x.mcap", "--publish-period", "1e-7"], 2, "more than 10,000,000; check clock_offset"),
        (["run", PAIR_TEAM, "-o", "x.yaml"], 2, r"x\.yaml: the name of the output must end in \.mcap"),
        (["run", PAIR_TEAM, "--save-team", PAIR_TEAM], 1, "is an input of this command"),
        (["query", PAIR_TEAM, "--box", *"555000"], 2, "box: every minimum must be below its maximum"),
        (["query", PAIR_TEAM, "--point", "nan", "0", "0"], 2, "point: expects finite numbers"),
        (["run", PAIR_TEAM, "-o", "x.mcap", "--resolution", "small"], 2, "'small' is not a valid float"),
        (["run", "--config-from", PAIR_TEAM, "-o", "x.mcap"], 1, "not a finished MCAP file"),
        (["info"], 2, "Missing argument"),
        (["info", "none.mcap"], 1, r"none\.mcap"),
        (["metrics", "none.mcap"], 1, r"none\.mcap: cannot be read"),
        (["metrics", PAIR / "husky_1.mcap"], 1, "no result of octoreplay"),
        (["query", "none.mcap"], 2, "name a point with --point X Y Z, or a box"),
        (["simulate", "x", "--image", "big"], 2, "image: expects WIDTHxHEIGHT such as 160x120, got 'big'"),
        (["simulate", "x", "--odometry-drift", "1"], 2, "odometry_drift: expects PERCENT,DEGREES such as 1,0.5, got"),
        (["simulate", "x", "--odometry-drift=1,nan"], 2, "odometry_drift in degrees per 10 m: nan is not between 0"),
        (["simulate", "x", "--robots", "0"], 2, "num_robots: 0 is not between 1 and 100"),
    ],
)
def test_wrong_usage_is_a_sentence_and_an_exit_code(
    arguments: list[object], code: int, sentence: str, tmp_path: Path
) -> None:
    done = octoreplay(*arguments, folder=tmp_path)
    assert done.returncode == code
    assert re.search(sentence, done.stderr), done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_help_shows_the_common_options_and_help_all_the_rest() -> None:
    shown, every = (octoreplay("run", option).stdout for option in ("--help", "--help-all"))
    options = re.compile(r"^  (?:-\w, )?(--[a-z0-9-]+)", re.M)
    common, known = options.findall(shown), options.findall(every)
    assert len(set(common) - {"--help", "--help-all"}) == 20
    assert {"--rule", "--resolution", "--topology", "--json"} <= set(common)
    assert set(common) < set(known)
    assert {f"--{name.replace('_', '-')}" for name in PARAMETERS} <= set(known)
    assert shown.endswith(f"\n{len(known) - len(common)} more options: octoreplay run --help-all\n")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["run", "--resolutoin", 1], "No such option '--resolutoin'; did you mean '--resolution'?"),
        (["rnu"], "No such command 'rnu'; did you mean 'run'?"),
        (["experiment", "papr"], "No such command 'papr'; did you mean 'paper'?"),
        (["run", "--rule", "baies"], "flood, merge, weighted, latest, local; did you mean 'bayes'?"),
        (["export", "r.mcap", "-o", "x.ply", "--what", "voxel"], "points, voxels; did you mean 'voxels'?"),
        (["run", "team.yaml", "-o", "x.mcap"], "resolutoin: unknown key; did you mean 'resolution'?"),
        (["run", "word.yaml", "-o", "x.mcap"], "rule: 'baies' is not one of"),
        (["run", "word.yaml", "-o", "x.mcap"], "did you mean 'bayes'?"),
    ],
)
def test_errors_name_the_most_similar_word(arguments: list[object], sentence: str, tmp_path: Path) -> None:
    team = PAIR_TEAM.read_text().replace("log: ", f"log: {PAIR}/")
    (tmp_path / "team.yaml").write_text(f"{team}\nresolutoin: 0.2\n")
    (tmp_path / "word.yaml").write_text(f"{team}\nrule: baies\n")
    done = octoreplay(*arguments, folder=tmp_path)
    assert done.returncode == 2
    assert sentence in done.stderr
