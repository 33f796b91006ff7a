"""Output files: locks, temporary names, and files and folders that appear when they are complete."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from octoreplay.errors import OutputError
from octoreplay.io import output_file
from octoreplay.io.output_file import OutputFile, locked, new_folder, unfinished, write_whole

HOLDER = """
import sys
from pathlib import Path
from octoreplay.io.output_file import locked
sys.argv = ["octoreplay", "run", "team file.yaml"]
with locked(Path(sys.stdin.readline().strip()), is_folder={is_folder}):
    print("held", flush=True)
    sys.stdin.readline()
"""


@contextmanager
def held(path: Path, *, is_folder: bool = False) -> Iterator[subprocess.Popen[str]]:
    """Hold the lock of an output in another process."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER.format(is_folder=is_folder)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(f"{path}\n")
        process.stdin.flush()
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("is_folder", [False, True])
def test_a_process_names_the_one_that_holds_the_output_and_takes_over_when_it_is_killed(
    tmp_path: Path, is_folder: bool
) -> None:
    path = tmp_path / "out"
    with held(path, is_folder=is_folder) as process:
        sentence = rf"out: is being written by process {process.pid} on .+ \(octoreplay run 'team file.yaml'\); wait"
        with pytest.raises(OutputError, match=sentence), locked(path, is_folder=is_folder):
            pass
        process.kill()
        process.wait()
        with locked(path, is_folder=is_folder):
            pass
    assert names(tmp_path) == (["out"] if is_folder else [])


def test_other_spellings_of_a_path_have_the_same_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "link").symlink_to(tmp_path)
    monkeypatch.chdir(tmp_path)
    with held(tmp_path / "out"):
        for path in (Path("out"), tmp_path / "link" / "out", tmp_path / "link" / ".." / tmp_path.name / "out"):
            with pytest.raises(OutputError, match="is being written by"):
                write_whole(path, "text")
    with locked(tmp_path / "out"), pytest.raises(OutputError, match=f"by process {os.getpid()} "):
        write_whole(Path("link/out"), "text")


def test_a_command_holds_the_lock_of_its_writer(tmp_path: Path) -> None:
    with locked(tmp_path / "out", is_awaited=True):
        write_whole(tmp_path / "out", "text")
        assert names(tmp_path) == [".out.lock", "out"]
    assert names(tmp_path) == ["out"]


def test_threads_do_not_mix_in_one_output(tmp_path: Path) -> None:
    path, refused = tmp_path / "out", []

    def write(letter: str) -> None:
        for _ in range(30):
            try:
                write_whole(path, letter * 1000)
            except OutputError:
                refused.append(letter)

    threads = [threading.Thread(target=write, args=(letter,)) for letter in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(path.read_text())) == 1
    assert len(refused) < 120
    assert names(tmp_path) == ["out"]


def test_a_lock_that_was_removed_while_a_process_waited_is_taken_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock_file, calls = output_file._lock_file, []

    def late(descriptor: int, target: Path) -> bool:
        # The holder ends, and removes the file, between the opening and the locking.
        if not calls:
            (tmp_path / ".out.lock").unlink()
        calls.append(os.fstat(descriptor).st_ino)
        return lock_file(descriptor, target)

    monkeypatch.setattr(output_file, "_lock_file", late)
    with locked(tmp_path / "out"):
        assert (tmp_path / ".out.lock").stat().st_ino == calls[-1]
        assert len(calls) == 2


def test_a_file_system_without_locks_is_warned_of_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    import fcntl

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    output_file._warn_without_locks.cache_clear()
    foreign = tmp_path / ".a.0a1b2c3d.tmp"
    foreign.touch()
    for name in "ab":
        write_whole(tmp_path / name, name)
    assert names(tmp_path) == [foreign.name, "a", "b"]
    assert [record.getMessage() for record in caplog.records] == [
        "warning: this file system has no locks; do not write one output from two processes at a time"
    ]


def test_what_killed_processes_left_of_the_same_output_is_removed(tmp_path: Path) -> None:
    for name in (".a.csv.0a1b2c3d.tmp", ".b.csv.0a1b2c3d.tmp", ".a.csv.tmp"):
        (tmp_path / name).touch()
    (tmp_path / ".a.csv.00000000.tmp").mkdir()
    write_whole(tmp_path / "a.csv", "text")
    assert names(tmp_path) == [".a.csv.tmp", ".b.csv.0a1b2c3d.tmp", "a.csv"]


def test_links_are_replaced_and_never_followed(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / "out").symlink_to(precious)
    write_whole(tmp_path / "out", "new")
    assert not (tmp_path / "out").is_symlink()
    (tmp_path / "file").symlink_to(precious)
    with pytest.raises(FileExistsError):
        OutputFile(tmp_path / "file")
    (tmp_path / ".next.lock").symlink_to(precious)
    with pytest.raises(OutputError, match="next: cannot be written: Too many levels of symbolic links"):
        write_whole(tmp_path / "next", "new")
    assert precious.read_text() == "mine"


def test_names_of_the_longest_size_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / ("é" * 127)
    write_whole(path, "text")
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_a_file_is_flushed_before_it_gets_its_name_and_its_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, order = tmp_path / "out", []
    fsync, replace = os.fsync, os.replace

    def noted(descriptor: int) -> None:
        order.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(os, "replace", lambda a, b: (order.append("name"), replace(a, b)))
    write_whole(path, "text")
    assert order == ["file", "name", "folder"]


def test_a_failed_write_leaves_the_bytes_of_the_writes_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, sizes = os.write, [3, 2]

    def full(descriptor: int, data: memoryview) -> int:
        if not sizes:
            raise OSError(errno.ENOSPC, "full")
        return write(descriptor, data[: sizes.pop(0)])

    with OutputFile(tmp_path / "out") as file:
        monkeypatch.setattr(os, "write", full)
        file.write(b"abc")
        with pytest.raises(OSError, match="full"):
            file.write(b"defg")
        assert file.is_damaged
        assert file.tell() == 3
    assert (tmp_path / "out").read_bytes() == b"abc"


def test_a_long_file_is_flushed_now_and_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced, clock = [], [0.0]
    monkeypatch.setattr(os, "fsync", lambda _: synced.append(clock[0]))
    monkeypatch.setattr(output_file.time, "monotonic", lambda: clock[0])
    with OutputFile(tmp_path / "out") as file:
        for _ in range(24):
            clock[0] += 0.5
            file.write(b"x")
    assert synced == [5.5, 11.0]


def test_a_new_folder_replaces_the_old_one_or_leaves_it(tmp_path: Path) -> None:
    folder = tmp_path / "poses"
    for text in ("one", "two"):
        with new_folder(folder) as new:
            write_whole(new.path / f"{text}.tum", text)
            new.put()
        assert names(folder) == [f"{text}.tum"]

    def fail() -> None:
        with new_folder(folder) as new:
            write_whole(new.path / "three.tum", "three")
            new.put()
            assert names(folder) == ["three.tum"]
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match="poses: cannot be written: No space left"):
        fail()
    assert names(folder) == ["two.tum"]
    with new_folder(folder) as new:
        new.put()
    assert names(tmp_path) == []


def test_temporary_files_are_removed_at_the_end_of_the_process(tmp_path: Path) -> None:
    code = "import sys; from pathlib import Path; from octoreplay.io import output_file as o;"
    code += "o.temporary_path(Path(sys.argv[1])).touch()"
    subprocess.run([sys.executable, "-c", code, tmp_path / "out"], check=True)
    assert names(tmp_path) == []


def test_an_unfinished_file_appears_with_its_name_or_not_at_all(tmp_path: Path) -> None:
    output = tmp_path / "a.mcap"
    with unfinished(output) as temporary:
        temporary.write_bytes(b"whole")
        assert not output.exists()
    assert names(tmp_path) == ["a.mcap"]


def test_the_name_of_a_process_has_no_credentials(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["octoreplay", "info", "https://user:word@host/a.mcap?signature=abc"])
    path = tmp_path / "out"
    with (
        locked(path),
        pytest.raises(OutputError, match=r"\(octoreplay info 'https://host/a.mcap'\); wait"),
        locked(path),
    ):
        pass
