"""Errors that no exit code covers, and standard streams that fail."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from octoreplay import cli
from octoreplay.commands import last_resort
from support.command_line import ENVIRONMENT, assert_fails, octoreplay
from support.fixture_paths import PAIR_TEAM
from support.long_suite import long

ACT = """
import sys, click
from octoreplay import cli
def act(): {body}
cli.cli.commands["act"] = click.Command("act", callback=act)
sys.argv = ["octoreplay", "act"]
cli.main()
"""


def process(body: str, *redirections: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command with this body in a process, with redirections of the shell."""
    return subprocess.run(
        ["/bin/sh", "-c", " ".join(['exec "$0" -c "$1"', *redirections]), sys.executable, ACT.format(body=body)],
        cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, **ENVIRONMENT, "TMPDIR": str(folder)},
    )  # fmt: skip


def test_an_unexpected_error_is_a_sentence_with_a_report(tmp_path: Path) -> None:
    done = process("{}['no \\x1b such key']", folder=tmp_path)
    (report,) = tmp_path.iterdir()
    assert done.returncode == 1
    assert done.stderr == (
        f"error: unexpected KeyError: 'no \\x1b such key'; this is a defect of octoreplay; the report is in {report}\n"
    )
    text = report.read_text()
    assert "Traceback" in text
    assert "octoreplay act" in text
    assert "numpy " in text


def test_a_report_has_no_credentials(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["octoreplay", "info", "http://user:hidden@host/a.mcap?signature=hidden"])
    report = last_resort._report(KeyError("http://host/a.mcap?signature=hidden"))
    assert report.startswith("octoreplay info 'http://host/a.mcap'\n")
    assert "hidden" not in report


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (MemoryError(), "out of memory; use a larger --resolution or a part of the logs; the report is in "),
        (RecursionError("maximum depth"), "unexpected RecursionError: maximum depth; this is a defect"),
        (OSError(5, "Input/output error", "x"), "[Errno 5] Input/output error: 'x'; the report is in "),
    ],
)
def test_each_kind_of_error_has_its_sentence(
    error: Exception, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert last_resort.sentence(error).startswith(sentence)


def test_a_report_that_cannot_be_saved_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    monkeypatch.chdir(tmp_path)
    assert f"the report is in {tmp_path}" in last_resort.sentence(ValueError("x"))

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "mkstemp", full)
    sentence = last_resort.sentence(ValueError("x"))
    assert sentence.endswith("no report could be saved ([Errno 28] No space left on device)")


@pytest.mark.parametrize(
    ("redirection", "code", "message"),
    [
        (">/dev/full", 3, "warning: standard output could not be written (No space left on device); files are not"),
        ("| true", 3, None),
        pytest.param(">&-", 0, "", marks=long),
        pytest.param(">/dev/full 2>/dev/full", 3, "", marks=long),
        ("<&- >&- 2>&-", 0, ""),
    ],
)
def test_the_text_of_a_command_does_not_change_its_files(
    redirection: str, code: int, message: str | None, tmp_path: Path
) -> None:
    body = (
        "import time; print('text', flush=True); time.sleep(0.3); print('\\udc80\\u03a6' * 9000);"
        " open('out', 'w').write('whole')"
    )
    if message is None:
        # The exit code of the first command of a pipe.
        body += "; import atexit, os; from octoreplay.commands import streams;"
        body += " open('lost', 'w').write(str(streams.output_error()))"
    done = process(body, redirection, folder=tmp_path)
    assert (tmp_path / "out").read_text() == "whole"
    if message is None:
        assert "Broken pipe" in (tmp_path / "lost").read_text()
    else:
        assert done.returncode == code, done.stderr
        assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_descriptors_that_the_parent_closed_are_not_used_for_files(tmp_path: Path) -> None:
    done = process("import os; fd = os.open('out', os.O_CREAT); open('number', 'w').write(str(fd))", "<&- >&- 2>&-",
                   folder=tmp_path)  # fmt: skip
    assert done.returncode == 0
    assert int((tmp_path / "number").read_text()) > 2


def test_an_incomplete_installation_is_a_sentence(tmp_path: Path) -> None:
    code = "import sys; sys.modules['click'] = None; from octoreplay.__main__ import main; main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: octoreplay is not installed completely (")


def test_a_message_is_shown_once() -> None:
    once = cli._Once()
    records = [logging.LogRecord("x", logging.WARNING, "", 0, "text %s", (argument,), None) for argument in "aab"]
    assert [once.filter(record) for record in records] == [True, False, True]


def test_a_run_does_not_remove_the_partial_result_of_config_from(tmp_path: Path) -> None:
    partial = tmp_path / "x.partial.mcap"
    partial.write_bytes(b"\x89MCAP0\r\n")
    done = octoreplay("run", "--config-from", partial, "-o", tmp_path / "x.mcap", "--restart")
    assert done.returncode == 1
    assert "this run would remove this result of --config-from; name another output" in done.stderr
    assert partial.exists()


@pytest.mark.parametrize(
    ("size", "code", "sentence"),
    [
        (245, 1, r"its name is too long for one ending in \.partial\.mcap"),
        (300, 2, "its name is longer than 255 bytes"),
    ],
)
def test_names_that_are_too_long_are_a_sentence(size: int, code: int, sentence: str, tmp_path: Path) -> None:
    output = tmp_path / f"{'a' * size}.mcap"
    assert_fails(code, sentence, "run", PAIR_TEAM, "-o", output)
    assert list(tmp_path.iterdir()) == []


def test_a_run_into_the_name_of_a_partial_result_is_refused(tmp_path: Path) -> None:
    done = octoreplay("run", PAIR_TEAM, "-o", tmp_path / "x.partial.mcap")
    assert done.returncode == 1
    assert "unfinished results end in .partial.mcap; name another output" in done.stderr
