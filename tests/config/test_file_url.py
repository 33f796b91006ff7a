"""URLs of input files."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from octoreplay.config.file_url import FileUrl, input_file, is_url, without_credentials
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import dump_team, parse_team
from octoreplay.errors import ConfigError

SIGNED = "https://user:word@host:8443/a/log.mcap?X-Signature=abc#part"


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("s3://bucket/a/log.mcap", "s3://bucket/a/log.mcap"),
        ("gs://bucket/what?#.mcap", "gs://bucket/what?#.mcap"),
        ("http://host/log.bag", "http://host/log.bag"),
        (SIGNED, "https://host:8443/a/log.mcap"),
    ],
)
def test_the_text_of_a_url_has_no_credentials(url: str, shown: str) -> None:
    assert str(FileUrl(url)) == shown
    assert repr(FileUrl(url)) == f"FileUrl({shown!r})"
    assert FileUrl(url).url == url
    assert FileUrl(url).public().url == shown
    assert pickle.loads(pickle.dumps(FileUrl(url))).url == url


def test_the_parts_of_a_url_are_those_of_a_path() -> None:
    url = FileUrl(SIGNED)
    assert (url.name, url.stem, url.suffix, url.parent.name) == ("log.mcap", "log", ".mcap", "a")
    assert url.resolve() is url


def test_urls_that_differ_in_the_query_are_different() -> None:
    assert FileUrl("http://host/log?id=1") != FileUrl("http://host/log?id=2")


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("ftp://host/log.mcap", "begin with s3://, gs://, http://, https://; mount other stores as folders"),
        ("s3://bucket", "names no file"),
        ("s3://bucket/recording/", "names no file"),
        ("s3://bucket/..", "names no file"),
        ("https://host/?id=1", "names no file"),
        ("s3:///log.mcap", "names no file"),
        ("s3://key:secret@bucket/log.mcap", "credentials do not belong in the URL"),
        ("http://[::1/log.mcap", "is not a URL"),
        ("s3://bucket/\0.mcap", "NUL"),
        (f"s3://bucket/{'x' * 256}", "longer than 255 bytes"),
    ],
)
def test_other_urls_are_refused(url: str, reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        FileUrl(url)
    assert reason in str(caught.value)
    assert "secret" not in str(caught.value)


def test_paths_and_urls_are_told_apart(tmp_path: Path) -> None:
    assert input_file("a/log.mcap", tmp_path) == tmp_path / "a" / "log.mcap"
    assert input_file("s3://bucket/log.mcap", tmp_path) == FileUrl("s3://bucket/log.mcap")
    assert input_file(FileUrl("s3://bucket/log.mcap")) == FileUrl("s3://bucket/log.mcap")
    assert is_url("memory://x")
    assert not is_url("s3:/bucket/log.mcap")
    assert not is_url(Path("s3://bucket/log.mcap"))


def test_a_team_file_keeps_urls_as_they_are(tmp_path: Path) -> None:
    text = f"""
robots:
- {{id: a, log: [{SIGNED}, part.mcap], pose_file: s3://bucket/a.tum, pose_times: times.txt}}
- {{id: b, log: gs://bucket/b.bag}}
"""
    config = parse_team(text, name="team.yaml", folder=tmp_path)
    a, b = config.robots
    assert a.logs == (FileUrl(SIGNED), tmp_path / "part.mcap")
    assert (a.pose_file, a.pose_times) == (FileUrl("s3://bucket/a.tum"), tmp_path / "times.txt")
    assert b.logs == (FileUrl("gs://bucket/b.bag"),)
    assert parse_team(dump_team(config, tmp_path), name="team.yaml", folder=tmp_path) == config
    assert a.with_absolute_paths().files == a.files


def test_the_paths_of_a_result_have_no_credentials(tmp_path: Path) -> None:
    robot = RobotConfig("a", (SIGNED, tmp_path / "part.mcap")).with_paths_from(tmp_path)
    assert robot.logs == (FileUrl("https://host:8443/a/log.mcap"), Path("part.mcap"))


def test_a_team_file_with_a_wrong_url_names_the_file() -> None:
    with pytest.raises(ConfigError, match=r"^team.yaml: 'ftp://\.\.\.': URLs of files begin"):
        parse_team("robots: [{id: a, log: ftp://host/x.mcap}]", name="team.yaml", folder=Path())


def test_urls_that_a_result_could_not_tell_apart_are_refused() -> None:
    robots = tuple(RobotConfig(f"r{n}", f"http://host/log.mcap?id={n}") for n in (1, 2))
    with pytest.raises(ConfigError, match=r"2 URLs of 'http://host/log.mcap' differ only in what results do not store"):
        RunConfig(robots)
    RunConfig((robots[0], RobotConfig("r2", robots[0].logs)))


def test_urls_in_texts_lose_their_credentials() -> None:
    text = "403, url='https://user:word@host/a?X-Signature=abc', and http://host:1/b?c d"
    assert without_credentials(text) == "403, url='https://host/a', and http://host:1/b d"
