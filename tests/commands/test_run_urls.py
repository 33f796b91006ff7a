"""Teams whose logs are named by URL, through the command line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from octoreplay.config.file_url import FileUrl
from octoreplay.config.team_file import load_team_file
from octoreplay.config.yaml_file import load_yaml
from octoreplay.errors import ConfigError
from octoreplay.io import remote_files
from octoreplay.io.containers.mcap_records import CRC_KEY
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.replay.run import replay_team
from support.clusters import dask
from support.command_line import assert_fails, octoreplay, octoreplay_process
from support.fixture_paths import PAIR, PAIR_TEAM
from support.interrupted import interrupted_after
from support.long_suite import long
from support.object_store import ObjectStore, store
from support.web_server import WebServer, web_server

__all__ = ["dask", "store"]

QUICK = ("-q", "--resolution", "0.6", "--settle", "1", "--duration", "2")
"""Options of a run of a quarter of a second."""
FOLDER = "s3://field/run 7/"


@pytest.fixture
def bucket(store: ObjectStore, tmp_path: Path) -> dict[str, str]:
    """Environment of a process that reads the logs of the pair from a store."""
    store.put("field")
    for number in (1, 2):
        store.put(f"field/run 7/husky_{number}.mcap", PAIR / f"husky_{number}.mcap")
    return {**store.environment, "XDG_CACHE_HOME": str(tmp_path / "cache")}


def team_of(folder: Path, place: str) -> Path:
    """Write the team file of the pair with logs in another place."""
    path = folder / "team.yaml"
    path.write_text(PAIR_TEAM.read_text().replace("log: husky", f"log: {place}husky"))
    return path


def content_of(path: Path, place: str) -> tuple[list[Any], dict[str, dict[str, Any]]]:
    """Return the messages and the metadata of a result, without the place of the logs."""
    with path.open("rb") as file:
        reader = make_reader(file)
        messages = [(schema.name, channel.topic, m.log_time, m.data) for schema, channel, m in reader.iter_messages()]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    found = {
        name: {key.replace(place, ""): value for key, value in values.items() if key != CRC_KEY}
        for name, values in metadata.items()
    }
    # YAML breaks lines where they are too long, so that the text depends on the length of names.
    found["config"]["team_file"] = json.dumps(load_yaml(found["config"]["team_file"], "config")).replace(place, "")
    return messages, found


@long
def test_a_run_from_a_store_equals_the_local_run(bucket: dict[str, str], tmp_path: Path) -> None:
    remote, local = tmp_path / "remote.mcap", tmp_path / "local.mcap"
    for path in PAIR.glob("*.mcap"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    done = octoreplay_process("run", team_of(tmp_path, FOLDER), "-o", remote, *QUICK, **bucket)
    assert done.returncode == 0
    assert done.stderr.splitlines() == [
        f"downloading {FOLDER}husky_{number}.mcap ({(PAIR / f'husky_{number}.mcap').stat().st_size:,} bytes)"
        for number in (1, 2)
    ]
    assert octoreplay_process("run", team_of(tmp_path, ""), "-o", local, *QUICK).returncode == 0
    assert content_of(remote, FOLDER) == content_of(local, FOLDER)
    with ResultReader(remote) as reader:
        assert list(reader.inputs) == [f"{FOLDER}husky_{number}.mcap" for number in (1, 2)]
        assert [robot.logs for robot in reader.config.robots] == [(FileUrl(name),) for name in reader.inputs]

    done = octoreplay_process("run", "--config-from", remote, "-o", tmp_path / "again.mcap", "-q", **bucket)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "again.mcap").read_bytes() == remote.read_bytes()


@long
def test_a_changed_log_is_named_and_fetched(bucket: dict[str, str], store: ObjectStore, tmp_path: Path) -> None:
    team, output = team_of(tmp_path, FOLDER), tmp_path / "out.mcap"
    assert octoreplay_process("run", team, "-o", output, *QUICK, **bucket).returncode == 0
    store.put("field/run 7/husky_1.mcap", PAIR / "husky_2.mcap")
    done = octoreplay_process("run", "--config-from", output, "-o", tmp_path / "again.mcap", "-q", **bucket)
    assert f"{FOLDER}husky_1.mcap: has changed since out.mcap was made from it" in done.stderr
    assert f"downloading {FOLDER}husky_1.mcap" in done.stderr
    assert f"downloading {FOLDER}husky_2.mcap" not in done.stderr


@long
def test_team_files_of_logs_in_a_store(bucket: dict[str, str], tmp_path: Path) -> None:
    urls = [f"{FOLDER}husky_{number}.mcap" for number in (1, 2)]
    done = octoreplay_process("init", *urls, "-o", tmp_path / "team.yaml", **bucket)
    assert done.returncode == 0, done.stderr
    saved = tmp_path / "saved" / "team.yaml"
    saved.parent.mkdir()
    done = octoreplay_process("run", *urls, "--save-team", saved, **bucket)
    assert done.returncode == 0, done.stderr
    for team in (tmp_path / "team.yaml", saved):
        assert [robot.logs for robot in load_team_file(team).robots] == [(FileUrl(url),) for url in urls]


@long
@pytest.mark.parametrize(
    ("url", "changes", "reason"),
    [
        ("s3://field/none.mcap", {}, "no such object; check the bucket or host, and the name"),
        ("s3://missing/none.mcap", {}, "no such object; check the bucket or host, and the name"),
        ("s3://field/run 7", {}, "is a folder; give the URL of one file"),
        (f"{FOLDER}husky_1.mcap", {"AWS_ACCESS_KEY_ID": "", "AWS_SECRET_ACCESS_KEY": "", "HOME": "/nowhere"},
         "no credentials were found; give them in the environment"),
        (f"{FOLDER}husky_1.mcap", {"AWS_ENDPOINT_URL": "http://127.0.0.1:1"}, "cannot be read: Could not connect to"),
    ],
)  # fmt: skip
def test_a_log_that_cannot_be_read_is_one_sentence(
    bucket: dict[str, str], tmp_path: Path, url: str, changes: dict[str, str], reason: str
) -> None:
    team = tmp_path / "team.yaml"
    team.write_text(f"robots: [{{id: a, log: '{url}'}}]")
    done = octoreplay_process("run", team, "-o", tmp_path / "out.mcap", **{**bucket, **changes})
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: {url}: {reason}")
    assert {path.name for path in tmp_path.iterdir()} <= {"team.yaml", "cache"}


@long
def test_workers_of_a_cluster_have_copies_of_their_own(
    bucket: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    for name, value in {**bucket, "XDG_CACHE_HOME": str(tmp_path / "workers")}.items():
        monkeypatch.setenv(name, value)
    cluster = request.getfixturevalue("dask")
    words = ("run", team_of(tmp_path, FOLDER), "-q", "--tiles", "9.6", "-o")
    done = octoreplay_process(*words, tmp_path / "out.mcap", "--scheduler", cluster.address, **bucket)
    assert done.returncode == 0, done.stderr
    copies = [sorted(path.name for path in (tmp_path / name).rglob("*.mcap")) for name in ("cache", "workers")]
    assert copies == [["husky_1.mcap", "husky_2.mcap"]] * 2
    assert octoreplay_process(*words, tmp_path / "local.mcap", **bucket).returncode == 0
    assert (tmp_path / "out.mcap").read_bytes() == (tmp_path / "local.mcap").read_bytes()


@long
def test_runs_of_a_sweep_share_the_copies(bucket: dict[str, str], tmp_path: Path) -> None:
    team = team_of(tmp_path, FOLDER)
    words = ("sweep", team, "-o", tmp_path / "sweep", "--vary", "gamma=0.1,0.2", "--jobs", 1, *QUICK[1:])
    done = octoreplay_process(*words, **bucket)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("downloading") == 2


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[WebServer]:
    """Web server with the logs of the pair, for a process with an empty cache folder."""
    pytest.importorskip("fsspec")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(remote_files, "_copies", {})
    with web_server() as server:
        server.files = {f"/{path.name}": path.read_bytes() for path in PAIR.glob("*.mcap")}
        yield server


def test_an_interrupted_run_continues_unless_a_log_has_changed(
    server: WebServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = {"resolution": 0.6, "settle": 1, "duration": 2.0}
    config = load_team_file(team_of(tmp_path, server.url("/"))).with_parameters(quick)
    replay_team(config, tmp_path / "whole.mcap")
    output = tmp_path / "out.mcap"
    interrupted_after(3, config, output, checkpoint_every=0.001)
    server.files["/husky_2.mcap"] = server.files["/husky_2.mcap"][:-1000]
    monkeypatch.setattr(remote_files, "_copies", {})
    with pytest.raises(ConfigError, match=rf"the log '{server.url('/husky_2.mcap')}' is not as it was; run with --res"):
        replay_team(config, output, resume=True)
    server.files["/husky_2.mcap"] = (PAIR / "husky_2.mcap").read_bytes()
    monkeypatch.setattr(remote_files, "_copies", {})
    replay_team(config, output, resume=True)
    assert output.read_bytes() == (tmp_path / "whole.mcap").read_bytes()


def test_results_do_not_hold_credentials(server: WebServer, tmp_path: Path) -> None:
    team, output = tmp_path / "team.yaml", tmp_path / "out.mcap"
    urls = [f"http://user:hidden@{server.address}/husky_{number}.mcap?signature=hidden" for number in (1, 2)]
    done = octoreplay("run", *urls, "--save-team", team, "-o", output, *QUICK)
    assert done.returncode == 0, done.stderr
    assert b"hidden" not in output.read_bytes()
    assert "hidden" not in done.stdout + done.stderr
    assert [robot.logs[0].url for robot in load_team_file(team).robots] == urls
    with ResultReader(output) as reader:
        assert list(reader.inputs) == [server.url(f"/husky_{number}.mcap") for number in (1, 2)]
    done = octoreplay("info", *urls, "--json")
    names = [server.url(f"/husky_{number}.mcap") for number in (1, 2)]
    assert [log["path"] for log in json.loads(done.stdout)["logs"]] == names
    assert "hidden" not in done.stdout


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("run", "s3://bucket/team.yaml", "-o", "out.mcap"), "'s3://bucket/team.yaml': only logs can be named by URL"),
        (("run", PAIR_TEAM, "-o", "s3://bucket/out.mcap"), r"'s3://\.\.\.': only logs can be named by URL"),
        (("info", "s3://key:hidden@bucket/x.mcap"), "credentials do not belong in the URL"),
        (("info", "abfs://bucket/x.mcap"), "mount other stores as folders"),
        (("info", "https://host/recording/"), "names no file"),
    ],
)
def test_other_urls_are_wrong_usage(words: tuple[object, ...], sentence: str) -> None:
    assert_fails(2, sentence, *words)


def test_a_bar_shows_a_download(monkeypatch: pytest.MonkeyPatch) -> None:
    import click

    from octoreplay.commands import console, progress
    from octoreplay.report import tables

    shown: list[float] = []
    real = tables.terminal
    monkeypatch.setattr(tables, "terminal", lambda **options: _as_terminal(real(**options)))
    with click.Context(click.Command("run")) as context:
        context.meta[console._KEY] = console.Terminal()
        with progress.download_bar(FileUrl("s3://bucket/log.mcap")) as update:
            assert progress._shown == ["download"]
            update(1, 4)
            # The terminal has one bar: another download at the same time shows none.
            with progress.download_bar(FileUrl("s3://bucket/other.mcap")) as other:
                other(1, None)
                shown.append(len(progress._shown))
    assert shown == [1]
    assert progress._shown == []


def _as_terminal(console: Any) -> Any:
    """The console as if it were a terminal."""
    console._force_terminal = True
    return console
