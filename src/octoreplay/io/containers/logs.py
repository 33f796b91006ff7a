"""Opening a log whatever its container: MCAP, ROS 1 bag, rosbag2 sqlite3 file or rosbag2 folder."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator
from pathlib import Path

from octoreplay.errors import InputError
from octoreplay.io.containers import mcap_log
from octoreplay.io.containers.bag_log import BagLog
from octoreplay.io.containers.cut_bag_log import CutBagLog
from octoreplay.io.containers.log_reader import LogReader, RawMessage, TopicInfo
from octoreplay.io.containers.mcap_log import McapLog

_MAGIC_LENGTH = 16


def open_log(path: Path) -> LogReader:
    """A reader of one log; use it as a context manager.

    What kind of log it is follows from its first bytes, not from its name. Raises InputError with one sentence where
    the path is missing, empty, or no log.
    """
    path = Path(path)
    if path.is_dir():
        return _open_folder(path)
    try:
        with path.open("rb") as file:
            magic = file.read(_MAGIC_LENGTH)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if not magic:
        raise InputError(f"{path}: the file is empty")
    if magic.startswith(mcap_log.MAGIC):
        return McapLog(path)
    if magic.startswith(b"#ROSBAG V"):
        return _open_bag(path)
    if magic.startswith(b"SQLite format 3"):
        if path.suffix != ".db3":
            raise InputError(f"{path}: a rosbag2 sqlite3 recording must end in .db3; rename it")
        return BagLog(path, is_ros1=False)
    raise InputError(f"{path}: not a log; MCAP (.mcap), ROS 1 bags (.bag) and rosbag2 (.db3 or folder) can be read")


def _open_bag(path: Path) -> LogReader:
    """A reader of a ROS 1 bag, also of one that was cut off before its index was written."""
    try:
        return BagLog(path, is_ros1=True)
    except InputError:
        log = CutBagLog(path)
        if log.message_count:
            return log
        log.close()
        raise


def _open_folder(path: Path) -> LogReader:
    """A reader of a rosbag2 folder; MCAP files in it are read directly, whatever times its metadata claims."""
    if not (path / "metadata.yaml").is_file():
        inside = sorted(p.name for p in path.iterdir() if p.suffix in (".mcap", ".db3", ".bag"))
        hint = f"; it holds {', '.join(inside[:5])}" if inside else ""
        raise InputError(f"{path}: a folder without metadata.yaml is no rosbag2 recording; name the files in it{hint}")
    files = _plain_mcap_files(path)
    return FolderLog(path, files) if files else BagLog(path, is_ros1=False)


def _plain_mcap_files(path: Path) -> list[Path]:
    """The folder's uncompressed MCAP files in the order of its metadata; empty for any other kind of recording."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        content = YAML(typ="safe", pure=True).load((path / "metadata.yaml").read_text(encoding="utf-8"))
        information = content["rosbag2_bagfile_information"]
        files = [path / Path(name).name for name in information["relative_file_paths"]]
        is_plain = information["storage_identifier"] == "mcap" and not information.get("compression_mode")
    except (OSError, UnicodeDecodeError, YAMLError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path / 'metadata.yaml'}: not the metadata of a rosbag2 recording") from error
    return files if is_plain else []


class FolderLog(LogReader):
    """A rosbag2 folder of MCAP files as one log."""

    def __init__(self, path: Path, files: list[Path]) -> None:
        super().__init__(path)
        self._logs: list[LogReader] = []
        try:
            self._logs.extend(open_log(file) for file in files)
        except BaseException:
            self.close()
            raise

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics, sorted by name and type; counts are summed over the files, channel ids are those of the first."""
        merged: dict[tuple[str, str, str], TopicInfo] = {}
        for topic in (topic for log in self._logs for topic in log.topics):
            key = (topic.name, topic.type_name, topic.encoding)
            seen = merged.get(key)
            count = topic.num_messages + (seen.num_messages if seen else 0)
            merged[key] = TopicInfo(*key, count, seen.channel_ids if seen else topic.channel_ids)
        return tuple(merged[key] for key in sorted(merged))

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message; None in a log without messages."""
        return min((log.start_ns for log in self._logs if log.start_ns is not None), default=None)

    @property
    def end_ns(self) -> int | None:
        """Log time of the last message; None in a log without messages."""
        return max((log.end_ns for log in self._logs if log.end_ns is not None), default=None)

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(log.message_count for log in self._logs)

    @property
    def damage(self) -> str | None:
        """What is missing from the first damaged file; None where all are good."""
        return next((log.damage for log in self._logs if log.damage is not None), None)

    def close(self) -> None:
        """Close all files; a second call does nothing."""
        for log in self._logs:
            log.close()

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of some topics in order of log time, read lazily; ties in the order of the files."""
        # A file is opened by the merge only when the ones before it have given a message, so order them by start.
        return heapq.merge(*(log.messages(topics) for log in self._logs), key=lambda message: message.log_time_ns)
