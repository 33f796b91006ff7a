"""Copies of files on a web server."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from octoreplay.config.file_url import FileUrl
from octoreplay.errors import ConfigError, InputError, OutputError
from octoreplay.io import remote_files
from octoreplay.io.containers.fingerprint import fingerprint, log_files
from octoreplay.io.containers.logs import open_log
from octoreplay.io.remote_files import cache_folder, local_copy
from octoreplay.io.robots.discover import discover
from octoreplay.io.robots.trajectories import read_rows
from support.command_line import octoreplay_process, started, wait_for
from support.fixture_paths import PAIR
from support.web_server import WebServer, web_server

pytest.importorskip("fsspec")
pytest.importorskip("aiohttp")

LOG = PAIR / "husky_1.mcap"

COPYING = """
import sys
from octoreplay.config.file_url import FileUrl
from octoreplay.io.remote_files import local_copy
print(local_copy(FileUrl(sys.argv[1])))
"""
"""Program that prints the path of the copy of a URL."""


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[WebServer]:
    """Server with a log, for a process with an empty cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    new_process(monkeypatch)
    with web_server() as server:
        server.files["/team/husky_1.mcap"] = LOG.read_bytes()
        yield server


def new_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget the copies that this process uses."""
    monkeypatch.setattr(remote_files, "_copies", {})


def log_url(server: WebServer) -> FileUrl:
    return FileUrl(server.url("/team/husky_1.mcap"))


def cached_files() -> list[Path]:
    return sorted(path for path in cache_folder().rglob("*") if path.is_file())


def test_a_path_is_its_own_copy() -> None:
    assert local_copy(LOG) is LOG


def test_an_object_is_downloaded_once(server: WebServer, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = local_copy(log_url(server))
    assert copy.read_bytes() == LOG.read_bytes()
    assert copy.name == "husky_1.mcap"
    assert copy.parent.parent == cache_folder()
    assert cached_files() == [copy]
    assert copy.parent.stat().st_mode & 0o077 == 0
    number = len(server.requests)
    assert local_copy(log_url(server)) == copy
    assert len(server.requests) == number
    new_process(monkeypatch)
    assert local_copy(log_url(server)) == copy
    assert server.num_downloads() == 1


@pytest.mark.parametrize("has_etag", [False, True])
def test_a_changed_object_is_downloaded_anew(server: WebServer, monkeypatch: pytest.MonkeyPatch, has_etag) -> None:
    server.has_etag = has_etag
    server.last_modified = None if has_etag else "Wed, 01 Jan 2025 10:00:00 GMT"
    first = local_copy(log_url(server))
    changed = bytes(reversed(LOG.read_bytes()))
    server.files["/team/husky_1.mcap"] = changed
    assert local_copy(log_url(server)) == first
    assert first.read_bytes() == LOG.read_bytes()
    server.last_modified = None if has_etag else "Wed, 01 Jan 2025 10:00:01 GMT"
    new_process(monkeypatch)
    second = local_copy(log_url(server))
    assert second != first
    assert second.read_bytes() == changed


def test_an_object_without_identity_is_downloaded_by_every_process(
    server: WebServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.has_etag = False
    local_copy(log_url(server))
    server.files["/team/husky_1.mcap"] = bytes(reversed(LOG.read_bytes()))
    new_process(monkeypatch)
    assert local_copy(log_url(server)).read_bytes() == bytes(reversed(LOG.read_bytes()))
    assert len(cached_files()) == 1


def test_an_object_without_a_length_is_downloaded(server: WebServer) -> None:
    server.has_length = False
    assert local_copy(log_url(server)).read_bytes() == LOG.read_bytes()


def test_a_damaged_copy_is_replaced(server: WebServer, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = local_copy(log_url(server))
    copy.write_bytes(b"cut")
    new_process(monkeypatch)
    assert local_copy(log_url(server)).read_bytes() == LOG.read_bytes()


def test_readers_name_the_url(server: WebServer) -> None:
    server.files["/poses.tum"] = b"0 0 0 0 0 0 0 1\n1 1 0 0 0 0 1 1\n"
    server.files["/wrong.tum"] = b"0 0 x\n"
    server.files["/wrong.mcap"] = b"no log at all, but text"
    url = log_url(server)
    with open_log(str(url)) as log, open_log(LOG) as same:
        assert log.path == url
        assert log.topics == same.topics
        message = next(iter(log.messages([log.topics[0].name])))
        assert message.where.startswith(f"{url}: topic ")
    assert fingerprint(url).value == fingerprint(LOG).value
    assert log_files(url) == (url,)
    assert [robot.robot_id for robot in discover([str(url)])] == ["husky_1"]
    assert len(read_rows(FileUrl(server.url("/poses.tum")))) == 2
    for path in ("/wrong.tum", "/wrong.mcap"):
        wrong = FileUrl(server.url(path))
        with pytest.raises(InputError) as caught:
            read_rows(wrong) if path.endswith("tum") else open_log(wrong)
        assert str(caught.value).startswith(str(wrong))
        assert str(cache_folder()) not in str(caught.value)


def test_an_object_of_a_google_bucket_is_downloaded(server: WebServer) -> None:
    """The server answers as the JSON interface of Google Cloud Storage does."""
    pytest.importorskip("gcsfs")
    data = LOG.read_bytes()
    about = {"name": "run/husky_1.mcap", "bucket": "field", "size": str(len(data)), "generation": "7"}
    server.files = {
        "/storage/v1/b/field/o/run%2Fhusky_1.mcap": json.dumps(about).encode(),
        "/download/storage/v1/b/field/o/run%2Fhusky_1.mcap": data,
    }
    environment = {**os.environ, "STORAGE_EMULATOR_HOST": f"http://{server.address}"}
    for url, found in (("gs://field/run/husky_1.mcap", data), ("gs://field/run/none.mcap", None)):
        done = subprocess.run(
            [sys.executable, "-c", COPYING, url], env=environment, capture_output=True, text=True, check=False
        )
        if found is None:
            assert done.stderr.splitlines()[-1].endswith(
                f"{url}: no such object; check the bucket or host, and the name"
            )
        else:
            assert (Path(done.stdout.strip()).read_bytes(), done.stderr) == (data, "")


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        (404, "no such object; check the bucket or host, and the name"),
        (401, "access was refused; check the credentials"),
        (403, "access was refused; check the credentials"),
        (503, "the server answered 503"),
    ],
)
def test_an_object_that_cannot_be_read_is_one_sentence(server: WebServer, status: int, reason: str) -> None:
    server.status = status
    if status == 404:
        server.files.clear()
    with pytest.raises(InputError) as caught:
        local_copy(log_url(server))
    assert str(caught.value) == f"{log_url(server)}: {reason}"
    assert not cached_files()


def test_a_server_that_does_not_answer_is_named(tmp_path: Path) -> None:
    with web_server() as server:
        address = server.address
    with pytest.raises(InputError, match=rf"^http://{address}/log.mcap: cannot be read: Cannot connect to host"):
        local_copy(FileUrl(f"http://{address}/log.mcap?secret=1"))


def test_credentials_are_used_and_not_shown(server: WebServer) -> None:
    url = FileUrl(f"http://user:word@{server.address}/team/husky_1.mcap?signature=abc")
    copy = local_copy(url)
    assert server.requests[-1] == ("HEAD", "/team/husky_1.mcap?signature=abc")
    assert set(server.authorizations) == {"Basic dXNlcjp3b3Jk"}
    assert "abc" not in str(copy)
    with open_log(url) as log:
        assert str(log.path) == server.url("/team/husky_1.mcap")
    server.files.clear()
    with pytest.raises(InputError) as caught:
        local_copy(FileUrl(f"http://user:word@{server.address}/none.mcap?signature=abc"))
    assert not any(secret in str(caught.value) for secret in ("word", "abc"))


def test_credentials_of_netrc_are_used(server: WebServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "netrc"
    path.write_text("machine 127.0.0.1 login user password word\n")
    path.chmod(0o600)
    monkeypatch.setenv("NETRC", str(path))
    local_copy(log_url(server))
    assert set(server.authorizations) == {"Basic dXNlcjp3b3Jk"}


def test_a_download_that_ends_early_leaves_nothing(server: WebServer, monkeypatch: pytest.MonkeyPatch) -> None:
    server.cut_at = 40_000
    with pytest.raises(InputError, match=r"husky_1.mcap: the download ended after [0-9,]+ bytes: .*; run the command"):
        local_copy(log_url(server))
    assert not cached_files()
    server.cut_at = None
    assert local_copy(log_url(server)).read_bytes() == LOG.read_bytes()


def test_an_object_that_changes_during_the_download_is_refused(server: WebServer) -> None:
    @contextlib.contextmanager
    def change(_: FileUrl) -> Iterator[remote_files.Progress]:
        server.files["/team/husky_1.mcap"] = bytes(reversed(LOG.read_bytes()))
        yield lambda *_: None

    remote_files.show_downloads(change)
    try:
        with pytest.raises(InputError, match="has changed while it was downloaded; run the command again"):
            local_copy(log_url(server))
    finally:
        remote_files.show_downloads(remote_files._hidden)
    assert not cached_files()


def test_downloads_are_shown(server: WebServer) -> None:
    seen: list[tuple[int, int | None]] = []

    @contextlib.contextmanager
    def show(file: FileUrl) -> Iterator[remote_files.Progress]:
        assert file == log_url(server)
        yield lambda done, size: seen.append((done, size))

    remote_files.show_downloads(show)
    try:
        local_copy(log_url(server))
    finally:
        remote_files.show_downloads(remote_files._hidden)
    size = LOG.stat().st_size
    assert seen[-1] == (size, size)
    assert sorted(seen) == seen


def test_a_full_disk_is_one_sentence(server: WebServer, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil._ntuple_diskusage(100, 90, 10)
    with monkeypatch.context() as context:
        context.setattr(shutil, "disk_usage", lambda path: usage)
        with pytest.raises(OutputError, match=r"takes 63,709 bytes, but .*/octoreplay/logs has 10 left; remove copies"):
            local_copy(log_url(server))

    # A limit of the size of files is an error of the disk, as no space is.
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000)){COPYING}"
    done = subprocess.run(
        [sys.executable, "-c", limited, log_url(server).url], capture_output=True, text=True, check=False
    )
    assert re.search(r"OutputError: .*octoreplay/logs: cannot be written: File too large; remove copies", done.stderr)
    assert not cached_files()


def test_a_cache_that_cannot_be_written_is_named(
    server: WebServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(OutputError, match=r"copies of files cannot be written: .*; name another folder in XDG_CACHE"):
        local_copy(log_url(server))


@pytest.mark.parametrize(
    ("package", "url"), [("fsspec", "s3://bucket/x.mcap"), ("s3fs", "s3://bucket/x.mcap"), ("gcsfs", "gs://bucket/x.mcap"),
                         ("aiohttp", "https://host/x.mcap")]
)  # fmt: skip
def test_a_missing_package_is_one_sentence(package: str, url: str, tmp_path: Path) -> None:
    (tmp_path / f"{package}.py").write_text("raise ImportError")
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-c", COPYING, url], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    scheme = url.partition("://")[0]
    assert done.stderr.splitlines()[-1] == (
        f"octoreplay.errors.ConfigError: {url}: {scheme}:// needs packages that are not installed; use pip install"
        " 'octoreplay[remote]'"
    )


def test_processes_share_one_download(server: WebServer) -> None:
    server.may_go_on.clear()
    words = [sys.executable, "-c", COPYING, log_url(server).url]
    processes = [subprocess.Popen(words, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    wait_for(lambda: sum(method == "HEAD" for method, _ in server.requests) == 3)
    server.may_go_on.set()
    copies = {process.communicate(timeout=60)[0].strip() for process in processes}
    assert copies == {str(local_copy(log_url(server)))}
    assert server.num_downloads() == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_download_leaves_no_copy(server: WebServer, number: signal.Signals) -> None:
    server.may_go_on.clear()
    with started("info", log_url(server).url) as process:
        assert server.after_half.wait(60)
        wait_for(lambda: any(path.name.endswith(".tmp") for path in cached_files()))
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert "Traceback" not in errors
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert not cached_files()
    server.may_go_on.set()
    assert local_copy(log_url(server)).read_bytes() == LOG.read_bytes()
    assert cached_files() == [local_copy(log_url(server))]


def test_info_shows_the_other_logs(server: WebServer) -> None:
    done = octoreplay_process("info", server.url("/none.mcap"), log_url(server).url)
    assert done.returncode == 1
    assert f"error: {server.url('/none.mcap')}: no such object" in done.stderr
    assert str(log_url(server)) in done.stdout


def test_without_a_home_the_cache_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> Path:
        raise RuntimeError

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", missing)
    with pytest.raises(ConfigError, match="XDG_CACHE_HOME: name the folder for copies"):
        cache_folder()
