"""rosbag2 folders: what their metadata says, and their files as one log."""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from octoreplay.errors import InputError
from octoreplay.io.containers.decompression import decompress_message
from octoreplay.io.containers.log_reader import LogReader, RawMessage, TopicInfo

METADATA = "metadata.yaml"
_STORAGES = ("mcap", "sqlite3")
_SPLIT_NAME = re.compile(r"(?P<prefix>.+)_(?P<number>\d+)")


@dataclass(frozen=True)
class FolderContents:
    """The files of a rosbag2 folder in their order; whether files, or single messages, are compressed with zstd."""

    files: tuple[Path, ...]
    has_compressed_files: bool = False
    has_compressed_messages: bool = False


def folder_contents(path: Path) -> FolderContents:
    """The contents of a rosbag2 folder, by its metadata or, without any, by the names of a split recording.

    Of the metadata only what files there are is used: its times and counts may be wrong. Raises InputError for a
    folder that is no recording, and for a compression that is not zstd.
    """
    if not (path / METADATA).is_file():
        return FolderContents(_split_files(path))
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    where = path / METADATA
    try:
        content = YAML(typ="safe", pure=True).load(where.read_text(encoding="utf-8"))
        information = content["rosbag2_bagfile_information"]
        # Old versions give the folder too.
        files = tuple(dict.fromkeys(path / Path(name).name for name in information["relative_file_paths"]))
        storage = str(information["storage_identifier"])
        mode = str(information.get("compression_mode") or "none").lower()
        compression = str(information.get("compression_format") or "")
    except (OSError, YAMLError, KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise InputError(f"{where}: not the metadata of a rosbag2 recording; name the log files themselves") from error
    if storage not in _STORAGES:
        raise InputError(f"{where}: storage '{storage}' cannot be read; convert the recording to mcap or sqlite3")
    if mode not in ("none", "file", "message") or (mode != "none" and compression != "zstd"):
        raise InputError(f"{where}: compression '{compression}' of mode '{mode}' cannot be read; use zstd or none")
    return FolderContents(files, mode == "file", mode == "message")


def _split_files(path: Path) -> tuple[Path, ...]:
    """The files of a split recording that was interrupted before its metadata was written, in their order."""
    logs = sorted(p for p in path.iterdir() if p.suffix in (".mcap", ".db3", ".bag"))
    names = [_SPLIT_NAME.fullmatch(p.stem) for p in logs if p.suffix != ".bag"]
    kinds = {(p.suffix, name["prefix"] if name else "") for p, name in zip(logs, names, strict=False)}
    if len(names) == len(logs) and len(kinds) == 1 and all(names):
        return tuple(sorted(logs, key=lambda p: (int(p.stem.rpartition("_")[2]), p.name)))
    hint = f"; it holds {', '.join(p.name for p in logs[:5])}" if logs else ""
    raise InputError(f"{path}: a folder without {METADATA} is no rosbag2 recording; name the files in it{hint}")


class FolderLog(LogReader):
    """A rosbag2 folder as one log of its open files.

    ``missing`` are sentences of files that are not among them. ``scratch`` is a folder that is removed at closing.
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
    def damage_clauses(self) -> tuple[str, ...]:
        """What is missing from the folder, and what is wrong with which of its files."""
        return (
            *self._damage.clauses,
            *(f"{log.path.name}: {clause}" for log in self._logs for clause in log.damage_clauses),
        )

    def close(self) -> None:
        """Close all files; a second call does nothing."""
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
        for message in self._merged(topics, start_ns, stop_ns):
            if not self._compressed_messages:
                yield message
                continue
            data = decompress_message(message.data)
            if data is None:
                bad[message.topic] += 1
                self._damage.lose(message.topic, bad[message.topic])
            else:
                yield RawMessage(message.log, message.channel, message.log_time_ns, bytearray(data))

    def _merged(self, topics: Collection[str], start_ns: int | None, stop_ns: int | None) -> Iterator[RawMessage]:
        """The messages of all files; a file is read from when its first message is due, so that few are at a time."""
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
    """Put a file's next message among those of the others; nothing where it has no more."""
    message = next(iterator, None)
    if message is not None:
        heapq.heappush(heads, (message.log_time_ns, index, message, iterator))
