"""A kill or a power cut in the middle of a run: all chunks that are whole on the disk can be read."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import SeekingReader

from octoreplay.errors import InputError
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.results.recovery import recover_result
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.result import open_result
from support.result_factory import state, team, tick_metrics
from support.trials import Trials

BLOCK = 512


@pytest.fixture
def whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """Bytes of an interrupted result of 30 ticks in many chunks."""
    monkeypatch.setitem(RosMcapWriter.__init__.__kwdefaults__, "chunk_size", 3000)

    def interrupt() -> None:
        with ResultWriter(tmp_path / "x.mcap", team(tmp_path)) as writer:
            for number in range(30):
                writer.write_metrics(tick_metrics(number))
                noise = np.random.default_rng(number).integers(0, 256, 400, np.uint8)
                writer.write_state(state("alpha", number, number, bytes(noise), key=number % 5 == 0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    return (tmp_path / "x.partial.mcap").read_bytes()


def messages(data: bytes) -> list[tuple[int, int, bytes, str]]:
    """Return place of the chunk, log time, bytes and topic of each message in a finished file."""
    reader = SeekingReader(io.BytesIO(data))
    summary = reader.get_summary()
    assert summary is not None
    starts = [chunk.chunk_start_offset for chunk in summary.chunk_indexes]
    sizes = [len(list(_chunk(data, chunk))) for chunk in summary.chunk_indexes]
    places = [start for start, size in zip(starts, sizes, strict=True) for _ in range(size)]
    found = [(m.log_time, m.data, c.topic) for _, c, m in reader.iter_messages(log_time_order=False)]
    return [(place, *message) for place, message in zip(places, found, strict=True)]


def _chunk(data: bytes, chunk: object) -> list[object]:
    """Return the messages of a chunk."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk, Message
    from mcap.stream_reader import breakup_chunk

    stream = io.BytesIO(data[chunk.chunk_start_offset + 9 :])
    return [record for record in breakup_chunk(Chunk.read(ReadDataStream(stream))) if isinstance(record, Message)]


def intact(data: bytes, damaged: bytes) -> list[tuple[int, bytes, str]]:
    """Return the messages of the chunks that are unchanged in a damaged copy."""
    reader = SeekingReader(io.BytesIO(data))
    summary = reader.get_summary()
    assert summary is not None
    spans = {c.chunk_start_offset: c.chunk_start_offset + c.chunk_length for c in summary.chunk_indexes}
    good = {start for start, end in spans.items() if damaged[start:end] == data[start:end]}
    return sorted((time, value, topic) for start, time, value, topic in messages(data) if start in good)


def stored(path: Path) -> list[tuple[int, bytes, str]]:
    """Return the messages that the own reader finds in an unfinished file."""
    with ResultReader(path, is_unfinished=True) as reader:
        container = reader._reader
        return sorted((m.log_time, m.data, c.topic) for _, c, m in container.iter_messages(log_time_order=False))


def check(path: Path, expected: list[tuple[int, bytes, str]]) -> None:
    """Check that the reader and ``recover`` find the expected messages."""
    found = stored(path)
    assert [entry for entry in expected if entry not in found] == []
    output = path.with_name("recovered.mcap")
    output.unlink(missing_ok=True)
    if not any(topic == "/metrics" for *_, topic in found):
        with pytest.raises(InputError, match="holds no tick"):
            recover_result(path, output)
        return
    recovery = recover_result(path, output)
    assert recovery.num_messages == len(found)
    assert sorted(entry[1:] for entry in messages(output.read_bytes())) == found
    with open_result(path) as direct, open_result(output) as again:
        assert not again.is_complete
        assert [repr(tick) for tick in again.metrics] == [repr(tick) for tick in direct.metrics]
        assert f"ends at tick {again.metrics[-1].tick}, " in recovery.extent


def test_a_killed_run_keeps_every_chunk(whole: bytes, tmp_path: Path, trials: Trials) -> None:
    first = SeekingReader(io.BytesIO(whole)).get_summary().chunk_indexes[0].chunk_start_offset
    path = tmp_path / "cut.partial.mcap"
    for random in trials.rounds(6, 2000):
        path.write_bytes(whole[: int(random.integers(first, len(whole)))])
        check(path, intact(whole, path.read_bytes()))


def flushed_at_once(data: bytes) -> list[int]:
    """Return the ends of the metadata and of the chunks with definitions, which are flushed when they are written."""
    chunks = SeekingReader(io.BytesIO(data)).get_summary().chunk_indexes
    places, channels = [chunks[0].chunk_start_offset], set()
    for chunk in chunks:
        if not chunk.message_index_offsets.keys() <= channels:
            places.append(chunk.chunk_start_offset + chunk.chunk_length)
        channels |= chunk.message_index_offsets.keys()
    return places


def test_blocks_that_were_not_flushed_are_lost_or_reordered(whole: bytes, tmp_path: Path, trials: Trials) -> None:
    flushed = flushed_at_once(whole)
    path = tmp_path / "cut.partial.mcap"
    for random in trials.rounds(6, 2000):
        end = int(random.integers(flushed[0], len(whole)))
        synced = int(random.integers(max(place for place in flushed if place <= end), end + 1))
        data = bytearray(whole[:end])
        blocks = range(-(-synced // BLOCK) * BLOCK, end, BLOCK)
        for start in blocks:
            kind = random.integers(4)
            if kind == 0:
                data[start : start + BLOCK] = bytes(len(data[start : start + BLOCK]))
            elif kind == 1 and random.random() < 0.3:
                other = int(random.choice(np.array(blocks)))
                data[start : start + BLOCK], data[other : other + BLOCK] = (
                    data[other : other + BLOCK],
                    data[start : start + BLOCK],
                )
        path.write_bytes(data[:end])
        check(path, intact(whole, path.read_bytes()))


def test_a_cut_result_under_its_final_name_is_damaged(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.mcap: not a finished MCAP file"):
        open_result(path)
    assert recover_result(path, tmp_path / "again.mcap").num_messages == len(intact(whole, path.read_bytes()))
