"""The command recover, and the commands that open an unfinished result."""

from __future__ import annotations

from pathlib import Path

import pytest

from octoreplay.result import open_result
from support.command_line import assert_fails, octoreplay, octoreplay_process, output_of
from support.long_suite import long
from support.result_factory import START, tick_metrics, write_killed, write_result


@pytest.fixture
def killed(pair_result: Path, tmp_path: Path) -> Path:
    """Result of the team of two robots without its end."""
    data = pair_result.read_bytes()
    path = tmp_path / "x.partial.mcap"
    path.write_bytes(data[: data.rindex(b"summary") - 20])
    return path


def test_an_unfinished_result_is_recovered(killed: Path, tmp_path: Path) -> None:
    done = octoreplay("recover", killed)
    assert done.returncode == 0, done.stderr
    assert f"wrote {tmp_path / 'x.recovered.mcap'} (" in done.stdout
    with open_result(tmp_path / "x.recovered.mcap") as result:
        last = result.metrics[-1]
        assert not result.is_complete
        assert result.summary.stop_reason == "cut off"
        leaves = result.map("husky_1").leaves()
    assert f"incomplete: the run did not finish, and its result ends at tick {last.tick}, " in done.stdout
    assert f"at log time {last.stamp_ns / 1e9:.3f} s" in done.stdout
    with open_result(killed) as result:
        assert (result.map("husky_1").leaves().log_odds == leaves.log_odds).all()
    assert_fails(1, r"x\.recovered\.mcap: already exists", "recover", killed)
    assert octoreplay("recover", killed, "--force").returncode == 0


def test_commands_open_an_unfinished_result_and_say_where_it_ends(killed: Path, tmp_path: Path) -> None:
    for arguments in (
        ["metrics", killed], ["export", killed, "-o", tmp_path / "m.ply"], ["query", killed, "--point", 0, 0, 0],
        ["evaluate", killed, "--last"], ["compare", killed, killed], ["check", killed, "--min-agreement", 0.1],
    ):  # fmt: skip
        done = octoreplay(*arguments)
        assert done.returncode == (1 if arguments[0] == "check" else 0), done.stderr
        assert "x.partial.mcap: incomplete: the run did not finish, and its result ends at tick" in done.stderr
    assert "the run was interrupted (cut off)" in output_of(1, "check", killed, "--min-agreement", 0.1)
    assert_fails(1, "x.partial.mcap: is a result of octoreplay, not a log", "info", killed)


def test_damage_before_the_end_has_its_exit_code(killed: Path) -> None:
    with open_result(killed) as result:
        chunks = result._reader._reader.get_summary().chunk_indexes
    data = bytearray(killed.read_bytes())
    data[chunks[-1].chunk_start_offset + 200] ^= 1
    killed.write_bytes(data)
    done = octoreplay("recover", killed)
    assert done.returncode == 3, done.stderr
    assert "1 damaged chunk" in done.stderr


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda folder: write_result(folder), "is complete; nothing needs to be recovered"),
        (
            lambda folder: write_result(folder).rename(folder / "x.partial.mcap"),
            r"x\.partial\.mcap: is complete, and only its name is missing; rename it to x\.mcap",
        ),
        (lambda folder: write_killed(folder / "x.mcap", []), "holds no tick; run the logs again"),
        (lambda folder: folder / "none.partial.mcap", "cannot be read: No such file"),
    ],
)
def test_what_cannot_be_recovered_is_refused(make, sentence: str, tmp_path: Path) -> None:
    path = make(tmp_path)
    before = sorted(tmp_path.iterdir())
    assert_fails(1, sentence, "recover", path)
    assert sorted(tmp_path.iterdir()) == before


def test_a_result_without_its_end_is_never_complete(tmp_path: Path) -> None:
    data = write_result(tmp_path).read_bytes()
    path = tmp_path / "cut.partial.mcap"
    # The summary is written before the last chunk.
    path.write_bytes(data[: data.rindex(b"summary") - 20])
    with open_result(path) as result:
        assert not result.is_complete
        assert result.summary.stop_reason == "cut off"


def test_a_flushed_tick_is_named(tmp_path: Path) -> None:
    from octoreplay.io.results.result_reader import ResultReader

    with ResultReader(write_result(tmp_path)) as reader:
        assert reader.last_tick() == (4, START + 4_000_000_000, 4.0)
        assert reader.damage == ()
    assert tick_metrics(4).stamp_ns == START + 4_000_000_000


@long
def test_names_are_escaped_in_all_lines(killed: Path, tmp_path: Path) -> None:
    hostile = tmp_path / "a\x1b[31m.partial.mcap"
    hostile.write_bytes(killed.read_bytes())
    for done in (octoreplay_process("recover", hostile), octoreplay_process("metrics", hostile)):
        assert done.returncode == 0, done.stderr
        assert "\x1b" not in done.stdout + done.stderr
        assert r"a\x1b[31m" in done.stdout + done.stderr
