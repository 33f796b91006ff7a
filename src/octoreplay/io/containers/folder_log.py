"""Reader of rosbag2 folders: their metadata, and their files as one log."""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from octoreplay.config.yaml_file import load_yaml, read_text
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.decompression import ContentBudget, decompress_message
from octoreplay.io.containers.log_reader import LogReader, RawMessage, TopicInfo
from octoreplay.io.remote_files import local_copy

METADATA = "metadata.yaml"
MAX_NODES = 1_000_000
"""Largest number of keys and values in the metadata; each file of a split recording takes about 13."""
_STORAGES = ("mcap", "sqlite3")
_SPLIT_NAME = re.compile(r"(?P<prefix>.+)_(?P<number>\d+)")


@dataclass(frozen=True)
class FolderContents:
    """Files of a rosbag2 folder in their order, and whether files or single messages are compressed with zstd."""

    files: tuple[Path, ...]
    has_compressed_files: bool = False
    has_compressed_messages: bool = False


def folder_contents(path: Path) -> FolderContents:
    """Return the contents of a rosbag2 folder from its metadata, or without metadata from the names of its files.

    Times and counts in the metadata are not used, because they may be wrong. Raises InputError for a folder that is not
    a recording, and for a compression other than zstd.
    """
    if not (path / METADATA).is_file():
        return FolderContents(_split_files(path))
    where = path / METADATA
    try:
        content = load_yaml(read_text(where, "recording"), str(where), MAX_NODES)
        information = content["rosbag2_bagfile_information"]
        # Old versions write the folder's name before the file's.
        files = tuple(dict.fromkeys(path / Path(name).name for name in information["relative_file_paths"]))
        storage = str(information["storage_identifier"])
        mode = str(information.get("compression_mode") or "none").lower()
        compression = str(information.get("compression_format") or "")
    except (ConfigError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(f"{where}: not the metadata of a rosbag2 recording; name the log files themselves") from error
    if storage not in _STORAGES:
        raise InputError(f"{where}: storage '{storage}' cannot be read; convert the recording to mcap or sqlite3")
    if mode not in ("none", "file", "message") or (mode != "none" and compression != "zstd"):
        raise InputError(f"{where}: compression '{compression}' of mode '{mode}' cannot be read; use zstd or none")
    return FolderContents(files, mode == "file", mode == "message")


def _split_files(path: Path) -> tuple[Path, ...]:
    """Return the files of a split recording that was interrupted before its metadata was written, in their order."""
    logs = sorted(p for p in path.iterdir() if p.suffix in (".mcap", ".db3", ".bag"))
    names = [_SPLIT_NAME.fullmatch(p.stem) for p in logs if p.suffix != ".bag"]
    kinds = {(p.suffix, name["prefix"] if name else "") for p, name in zip(logs, names, strict=False)}
    if len(names) == len(logs) and len(kinds) == 1 and all(names):
        return tuple(sorted(logs, key=lambda p: (int(p.stem.rpartition("_")[2]), p.name)))
    hint = f"; it holds {', '.join(p.name for p in logs[:5])}" if logs else ""
    raise InputError(f"{path}: a folder without {METADATA} is not a rosbag2 recording; name the files in it{hint}")


class FolderLog(LogReader):
    """A rosbag2 folder as one log. It closes its open ``logs`` and removes the folder ``scratch`` when it is closed.

    ``missing`` are clauses on files that could not be opened. With ``compressed_messages`` each message is decompressed
    with zstd.
    """

    def __init__(
        self, path: Path, logs: Sequence[LogReader], *, missing: Sequence[str] = (), compressed_messages: bool = False,
        scratch: TemporaryDirectory[str] | None = None,
    ) -> None:  # fmt: skip
        super().__init__(path)
        self._logs = tuple(logs)
        self._compressed_messages = compressed_messages
        self._scratch = scratch
        for clause in missing:
            self._damage.note(clause)

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """Topics, sorted by name and type, with counts of all files and the channel ids of the first."""
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
        """Number of messages of all topics."""
        return sum(log.message_count for log in self._logs)

    @property
    def damage_clauses(self) -> tuple[str, ...]:
        """Clauses on missing files, and on the damage of each file."""
        return (
            *self._damage.clauses,
            *(f"{log.path.name}: {clause}" for log in self._logs for clause in log.damage_clauses),
        )

    def close(self) -> None:
        """Close all files and remove the scratch folder; a second call does nothing."""
        for log in self._logs:
            log.close()
        if self._scratch is not None:
            self._scratch.cleanup()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Messages of some topics in order of log time, read lazily; equal times in the order of the files.

        Only messages with ``start_ns <= log_time_ns < stop_ns`` are given; None leaves that side open. Files without
        messages in this range are not read.
        """
        bad: Counter[str] = Counter()
        budget = ContentBudget(self.path, sum(local_copy(log.path).stat().st_size for log in self._logs))
        for message in self._merged(topics, start_ns, stop_ns):
            if not self._compressed_messages:
                yield message
                continue
            data = decompress_message(message.data)
            if data is None:
                bad[message.topic] += 1
                self._damage.skip_messages(message.topic, bad[message.topic])
            else:
                budget.take(len(data))
                yield RawMessage(message.log, message.channel, message.log_time_ns, bytearray(data))

    def _merged(self, topics: Collection[str], start_ns: int | None, stop_ns: int | None) -> Iterator[RawMessage]:
        """Merge the messages of all files by log time; a file is read only from the time of its first message on."""
        waiting = sorted(
            ((log.start_ns, i) for i, log in enumerate(self._logs) if log.start_ns is not None), reverse=True
        )
        heads: list[tuple[int, int, RawMessage, Iterator[RawMessage]]] = []
        while waiting or heads:
            while waiting and (not heads or waiting[-1][0] <= heads[0][0]):
                _, index = waiting.pop()
                _push(heads, index, self._logs[index].messages(topics, start_ns, stop_ns))
            if len(heads) == 1 and not waiting:
                _, _, message, iterator = heads[0]
                yield message
                yield from iterator
                return
            if heads:
                _, index, message, iterator = heapq.heappop(heads)
                yield message
                _push(heads, index, iterator)


def _push(
    heads: list[tuple[int, int, RawMessage, Iterator[RawMessage]]], index: int, iterator: Iterator[RawMessage]
) -> None:
    """Push a file's next message on the heap; nothing at the end of the file."""
    message = next(iterator, None)
    if message is not None:
        heapq.heappush(heads, (message.log_time_ns, index, message, iterator))
