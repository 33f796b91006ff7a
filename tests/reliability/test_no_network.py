"""No command opens a network connection or a listening socket: they run in processes where sockets raise."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from support.command_line import ENVIRONMENT
from support.fixture_paths import PAIR

REFUSING = """
import socket, sys

def record(event, *arguments):
    with open({log!r}, "a") as file:
        print(event, arguments, sys.argv, file=file)
    raise OSError("no network")

def refuse(event, arguments):
    # urllib3, which Open3D imports, binds a socket to see whether there is IPv6, and closes it.
    if event == "socket.bind" and arguments[1] == ("::1", 0):
        return
    if event in ("socket.bind", "socket.connect", "socket.getaddrinfo", "socket.sendto", "socket.gethostbyname"):
        record(event, *arguments[1:])

sys.addaudithook(refuse)
socket.socket.listen = lambda self, *arguments: record("socket.listen", *arguments)
"""
"""Module that refuses every use of the network and records it, in all child processes too."""


def run(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder in a process without network."""
    (folder / "refusing").mkdir(exist_ok=True)
    log = folder / "used"
    (folder / "refusing" / "sitecustomize.py").write_text(REFUSING.format(log=str(log)))
    paths = [str(folder / "refusing"), *filter(None, [os.environ.get("PYTHONPATH")])]
    done = subprocess.run(
        [sys.executable, "-m", "octoreplay", *map(str, arguments)], cwd=folder, text=True, capture_output=True,
        check=False, timeout=300, env={**os.environ, **ENVIRONMENT, "PYTHONPATH": os.pathsep.join(paths)},
    )  # fmt: skip
    assert not log.exists(), log.read_text()
    return done


def test_the_refusal_is_recorded(tmp_path: Path) -> None:
    """The test can fail: a process that uses the network leaves a record."""
    (tmp_path / "sitecustomize.py").write_text(REFUSING.format(log=str(tmp_path / "used")))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    for call in ("bind(('127.0.0.1', 0))", "listen()", "connect(('127.0.0.1', 9))"):
        code = f"import socket; socket.socket().{call}"
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=False)
        assert done.returncode == 1
    events = [line.split()[0] for line in (tmp_path / "used").read_text().splitlines()]
    assert events == ["socket.bind", "socket.listen", "socket.connect"]


@pytest.mark.long
def test_no_command_uses_the_network(tmp_path: Path) -> None:
    for path in PAIR.glob("*.mcap"):
        shutil.copy(path, tmp_path)
    shutil.copy(PAIR / "team.yaml", tmp_path)
    commands = (
        ("--help",),
        ("--version",),
        ("info", "husky_1.mcap"),
        ("init", "husky_1.mcap", "husky_2.mcap", "-o", "new.yaml"),
        ("run", "team.yaml", "-o", "a.mcap"),
        ("run", "team.yaml", "-o", "b.mcap", "--align", "--settle", 0),
        ("align", "team.yaml", "-o", "aligned.yaml"),
        ("metrics", "a.mcap", "--csv", "a.csv", "--plot", "figures"),
        ("export", "a.mcap", "-o", "a.ply"),
        ("query", "a.mcap", "--point", 1, 0, 0),
        ("check", "a.mcap", "--min-agreement", 0.1),
        ("compare", "a.mcap", "b.mcap"),
        ("evaluate", "a.mcap", "--truth", PAIR / "world.npz"),
        ("simulate", "logs", "--robots", 2, "--duration", 2, "--world-size", 30),
        ("sweep", "team.yaml", "-o", "sweep", "--vary", "gamma=0.1,0.2", "--jobs", 1),
    )
    for arguments in commands:
        done = run(tmp_path, *arguments)
        assert done.returncode in (0, 1, 3), (arguments, done.stdout, done.stderr)
        assert "Traceback" not in done.stderr
