"""Reader of cut and damaged sqlite3 files of rosbag2: every row that can still be read, by row number.

The index of times is not used: its pages lie among those of the rows, and a cut removes some of them.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from octoreplay.errors import InputError
from octoreplay.io.containers.block_log import Block, BlockBuilder, BlockLog, Entry, Index
from octoreplay.io.containers.log_reader import Channel, normalise_type_name

_BLOCK_BYTES = 1 << 20
_HEADER_BYTES = 100
_COMPARED_BYTES = 64
_MAX_ROW = (1 << 63) - 1
_TABLES = "SELECT name FROM sqlite_master WHERE type = 'table'"
_TOPICS = "rowid, name, type, serialization_format"
_HEADS = "rowid, topic_id, timestamp, length(data)"
_ROWS = "rowid, topic_id, timestamp, data"
_DEFINITIONS = "rowid, topic_type, encoding, encoded_message_definition"


class DamagedDb3Log(BlockLog):
    """A sqlite3 recording that is cut or damaged. Raises InputError where its tables cannot be found."""

    def __init__(self, path: Path) -> None:
        self._recording = path
        self._database = sqlite3.connect(":memory:")
        self._cut_end = b""
        self._is_sound = True
        try:
            super().__init__(path)
        except BaseException:
            self._database.close()
            raise

    @property
    def damage_clauses(self) -> tuple[str, ...]:
        """Clauses on what is damaged and what was skipped; empty for a good database."""
        return super().damage_clauses or (() if self._is_sound else ("its pages are damaged, and rows may be missing",))

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        super().close()
        self._database.close()

    def _read_index(self) -> Index:
        """Return the index of blocks of rows, from one pass over row number, topic, time and length of the rows."""
        try:
            self._database.close()
            self._database = _connect(self._recording, self._size)
            self._tables = {name for (name,) in self._database.execute(_TABLES)}
        except sqlite3.Error as error:
            raise InputError(f"{self.path}: cannot be read: {error}") from error
        page_size, num_pages = _page_counts(self._bytes_at(0, _HEADER_BYTES))
        if page_size * num_pages > self._size:
            self._damage.note("cut before its end")
            last_page = self._bytes_at(self._size - self._size % page_size, self._size % page_size)
            self._cut_end = last_page.rstrip(b"\0")[-_COMPARED_BYTES:]
        index = Index(self._read_channels())
        if not index.channels or "messages" not in self._tables:
            raise InputError(f"{self.path}: cannot be read: its table of topics or its table of messages is lost")
        builder, first, last, num_bytes, next_row = BlockBuilder(index.tally), 0, 0, 0, 0
        for row, topic_id, timestamp, length in self._rows("messages", _HEADS, 0, _MAX_ROW):
            if builder.num_messages and (num_bytes > _BLOCK_BYTES or row != next_row):
                index.blocks += builder.build(first, last - first + 1)
                builder, num_bytes = BlockBuilder(index.tally), 0
            first = row if not builder.num_messages else first
            last, next_row = row, row + 1
            if isinstance(topic_id, int) and isinstance(timestamp, int) and isinstance(length, int):
                builder.add(topic_id, timestamp)
                num_bytes += length
        index.blocks += builder.build(first, last - first + 1)
        self._damage.skip_messages(-1, index.tally.drop_unknown(index.channels))
        self._is_sound = bool(self._damage.clauses) or self._has_sound_pages()
        return index

    def _read_block(self, block: Block, wanted: Collection[int]) -> Iterator[Entry]:
        """Yield the messages of the wanted topics in a block of rows."""
        for row, topic_id, timestamp, data in self._rows("messages", _ROWS, block.offset, block.offset + block.length):
            if topic_id not in wanted or not isinstance(timestamp, int) or not isinstance(data, bytes):
                continue
            if self._is_cut(data):
                self._damage.skip_part("part", row, 1)
            else:
                yield timestamp, row, 0, len(data), topic_id, data

    def _is_cut(self, data: bytes) -> bool:
        """Return True if the file ends within the row ``data``; SQLite reads missing bytes as zeros."""
        if not self._cut_end:
            return False
        known = data.rstrip(b"\0")[-len(self._cut_end) :]
        return self._cut_end.endswith(known)

    def _has_sound_pages(self) -> bool:
        """Return True if SQLite's check of the pages finds no damage."""
        try:
            return bool(self._database.execute("PRAGMA quick_check(1)").fetchone() == ("ok",))
        except sqlite3.Error:
            return False

    def _read_channels(self) -> dict[int, Channel]:
        """Return the topics as channels, with their types' definitions where the recording has them."""
        definitions = {
            type_name: (str(encoding), text.encode())
            for _, type_name, encoding, text in self._rows("message_definitions", _DEFINITIONS, 0, _MAX_ROW)
            if encoding in ("ros2msg", "ros2idl") and isinstance(text, str)
        }
        return {
            number: Channel(name, normalise_type_name(type_name), encoding, *definitions.get(type_name, ("", b"")))
            for number, name, type_name, encoding in self._rows("topics", _TOPICS, 0, _MAX_ROW)
            if all(isinstance(value, str) for value in (name, type_name, encoding))
        }

    def _rows(self, table: str, columns: str, first: int, stop: int) -> Iterator[tuple[Any, ...]]:
        """Yield the rows with ``first`` <= row number < ``stop``; rows that cannot be read are skipped."""
        if table not in self._tables:
            return
        query = f"SELECT {columns} FROM {table} WHERE rowid >= ? AND rowid < ? ORDER BY rowid"
        while first < stop:
            with suppress(sqlite3.Error, ValueError, OverflowError):
                for row in self._database.execute(query, (first, stop)):
                    if row[0] < first:
                        # A damaged page may lead back to earlier rows.
                        break
                    yield row
                    first = row[0] + 1
                else:
                    return
            # A cursor is one row ahead, so damage also hides the row before it. Asked for alone, that row is found.
            row = self._next_row(f"{query} LIMIT 1", first, stop)
            if row is None:
                self._note_gap(table, first, stop)
                return
            self._note_gap(table, first, row[0])
            yield row
            first = row[0] + 1

    def _note_gap(self, table: str, first: int, stop: int) -> None:
        """Record rows that cannot be read. Recorders number rows consecutively; the last row number is unknown."""
        if table == "messages" and first < stop:
            self._damage.skip_part("part", first, stop - first if stop < _MAX_ROW else None)

    def _next_row(self, query: str, first: int, stop: int) -> tuple[Any, ...] | None:
        """Return the next readable row from a row number on; None where there is none.

        Damaged pages hold consecutive rows, so the search doubles its step until it finds a row, then bisects.
        """
        bad, good = first - 1, first
        while (row := self._row(query, good, stop)) is None:
            if good >= stop:
                return None
            bad, good = good, min(stop, 2 * good - first + 1)
        while good - bad > 1:
            middle = (bad + good) // 2
            found = self._row(query, middle, stop)
            bad, good, row = (middle, good, row) if found is None else (bad, middle, found)
        return row

    def _row(self, query: str, first: int, stop: int) -> tuple[Any, ...] | None:
        """Return the first row from a row number on; None where it cannot be read or none is left before ``stop``."""
        if first >= stop:
            return None
        try:
            row: tuple[Any, ...] | None = self._database.execute(query, (first, stop)).fetchone()
        except (sqlite3.Error, ValueError, OverflowError):
            return None
        return row if row is not None and row[0] >= first else None


def _page_counts(header: bytes) -> tuple[int, int]:
    """Return page size [bytes] and number of pages (https://www.sqlite.org/fileformat.html, section 1.3)."""
    page_size = int.from_bytes(header[16:18], "big")
    # A page size of 65536 is stored as 1, because it does not fit into two bytes.
    return 65536 if page_size == 1 else page_size, int.from_bytes(header[28:32], "big")


def check_schema(path: Path) -> None:
    """Raise InputError for a database whose rows are computed: a view can give any number of rows of any size."""
    with closing(_connect(path, path.stat().st_size)) as database:
        try:
            kinds = {kind for (kind,) in database.execute("SELECT type FROM sqlite_master")}
            names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            # Ordinary columns are not hidden; generated and those of virtual tables are.
            is_stored = all(
                not hidden
                for name in names
                for (hidden,) in database.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,))
            )
        except sqlite3.Error:
            # A damaged schema has nothing to compute.
            return
    if not kinds <= {"table", "index"} or not is_stored:
        raise InputError(
            f"{path}: cannot be read: it has views, triggers or generated columns; rosbag2 writes plain tables only"
        )


def _connect(path: Path, size: int) -> sqlite3.Connection:
    """Open a database whose end may be missing; values are limited to the size of the file."""
    database = sqlite3.connect(f"file:{quote(str(path.absolute()))}?immutable=1", uri=True, check_same_thread=False)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, _BLOCK_BYTES))
    database.text_factory = lambda data: data.decode("utf-8", "replace")
    # Without it, SQLite refuses a database with fewer pages than its header gives.
    database.execute("PRAGMA writable_schema = ON")
    database.execute("PRAGMA trusted_schema = OFF")
    return database
