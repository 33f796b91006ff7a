"""Damaged logs: intact messages are read, damage is counted, and wrong sizes allocate no memory."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as Rosbag1Writer

from octoreplay.errors import InputError
from octoreplay.io.containers.bag_records import CHUNK, read_head
from octoreplay.io.containers.damage import Damage, damage_sentence
from octoreplay.io.containers.decompression import MAX_CHUNK_BYTES, decompress, is_plausible_size
from octoreplay.io.containers.logs import open_log
from support.log_damage import (
    NUM_MESSAGES,
    STRINGS,
    mcap_chunks,
    read_all,
    text_of,
    write_strings_bag,
    write_strings_mcap,
    write_strings_rosbag2,
)  # fmt: skip

COMPRESSIONS = [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD]
TIMES = " (log times 0.000 s to 0.000 s)"
"""Span of the messages of these tests, which are nanoseconds apart."""


def times(path: Path) -> list[int]:
    return [time for _, time, _ in read_all(path).messages]


def times_of_chunk(records: bytes) -> list[int]:
    """Log times of the messages in a chunk of an MCAP file."""
    found, place = [], 0
    while place < len(records):
        opcode, length = struct.unpack_from("<BQ", records, place)
        if opcode == 5:
            found.append(struct.unpack_from("<Q", records, place + 15)[0])
        place += 9 + length
    return found


def without(*lost: int) -> list[int]:
    return [time for time in range(1, NUM_MESSAGES + 1) if time not in lost]


def put(path: Path, place: int, piece: bytes) -> None:
    data = bytearray(path.read_bytes())
    data[place : place + len(piece)] = piece
    path.write_bytes(data)


# --- MCAP ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("has_summary", [True, False])
@pytest.mark.parametrize("back", [1, 12, 40])
def test_an_mcap_chunk_with_a_wrong_checksum_is_skipped_and_counted(tmp_path, compression, has_summary, back):
    path = write_strings_mcap(tmp_path / "a.mcap", compression=compression)
    data = path.read_bytes()
    chunk = mcap_chunks(data)[2]
    put(path, chunk.end - back, bytes([data[chunk.end - back] ^ 0x10]))
    if not has_summary:
        path.write_bytes(path.read_bytes()[:-20])
    lost = times_of_chunk(chunk.records)
    outcome = read_all(path)
    assert [time for _, time, _ in outcome.messages] == without(*lost)
    missing_end = "" if has_summary else "cut after its last message (the end of the file is missing), and "
    skipped = f"1 damaged chunk with {len(lost)} messages{TIMES} was skipped; everything else is used{TIMES}"
    assert outcome.damage == f"{path}: {missing_end}{skipped}"


def test_damage_counts_once_when_a_log_is_read_repeatedly(tmp_path, caplog):
    path = write_strings_mcap(tmp_path / "a.mcap")
    chunks = mcap_chunks(path.read_bytes())
    for chunk in (chunks[1], chunks[4]):
        put(path, chunk.end - 5, b"\xff\xff")
    with open_log(path) as log:
        assert log.damage is None
        for topics in (["/a"], ["/b"], ["/a", "/b"]):
            list(log.messages(topics))
        num_lost = sum(len(times_of_chunk(chunks[i].records)) for i in (1, 4))
        assert f": 2 damaged chunks with {num_lost} messages{TIMES} were skipped;" in log.damage
    assert caplog.text == ""


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_reading_of_an_mcap_resumes_at_the_next_intact_chunk(tmp_path, compression):
    path = write_strings_mcap(tmp_path / "a.mcap", compression=compression)
    data = path.read_bytes()
    third = mcap_chunks(data)[2]
    # The third chunk has a wrong length, so its end is unknown, and the summary is removed.
    path.write_bytes(data[: third.start + 1] + struct.pack("<Q", 123) + data[third.start + 9 : -30])
    outcome = read_all(path)
    assert [time for _, time, _ in outcome.messages] == without(*times_of_chunk(third.records))
    assert "1 damaged part with an unknown number of messages was skipped" in outcome.damage


def test_a_chunk_length_beyond_the_end_of_the_file_is_not_a_cut(tmp_path):
    path = write_strings_mcap(tmp_path / "a.mcap")
    data = path.read_bytes()
    first = mcap_chunks(data)[1]
    path.write_bytes(data[: first.start + 1] + struct.pack("<Q", len(data)) + data[first.start + 9 : -30])
    assert times(path) == without(*times_of_chunk(first.records))


@pytest.mark.parametrize("length", [5_000, 1 << 40])
def test_a_wrong_length_of_a_record_between_chunks_loses_no_chunk(tmp_path, length):
    path = write_strings_mcap(tmp_path / "a.mcap")
    data = path.read_bytes()
    index = mcap_chunks(data)[2].end
    assert data[index] == 7
    path.write_bytes(data[: index + 1] + struct.pack("<Q", length) + data[index + 9 : -30])
    assert times(path) == without()


def test_a_damaged_chunk_with_a_wrong_message_index_is_counted(tmp_path):
    path = write_strings_mcap(tmp_path / "a.mcap")
    chunk = mcap_chunks(path.read_bytes())[2]
    put(path, chunk.end - 3, b"\xff\xff")
    put(path, chunk.end + 1, struct.pack("<Q", (1 << 64) - 1))
    outcome = read_all(path)
    assert [time for _, time, _ in outcome.messages] == without(*times_of_chunk(chunk.records))
    assert outcome.damage.startswith(f"{path}: 1 damaged chunk with ")


def test_reading_of_an_mcap_without_chunks_resumes_at_the_next_records(tmp_path):
    path = write_strings_mcap(tmp_path / "a.mcap", use_chunking=False)
    data = path.read_bytes()
    place = data.index(b"\x05", len(data) // 2)
    path.write_bytes(data[:place] + bytes(50) + data[place + 50 :])
    outcome = read_all(path)
    assert NUM_MESSAGES - 3 <= len(set(outcome.messages)) < NUM_MESSAGES
    assert outcome.messages[-1][1] == NUM_MESSAGES
    assert "1 damaged part with an unknown number of messages was skipped" in outcome.damage


def test_a_summary_with_a_wrong_checksum_is_not_used(tmp_path):
    path = write_strings_mcap(tmp_path / "a.mcap")
    data = path.read_bytes()
    (summary_start,) = struct.unpack_from("<Q", data, len(data) - 8 - 20)
    # The name of a topic, which is in the summary and in the first chunk.
    put(path, data.index(b"/a", summary_start), b"/x")
    with open_log(path) as log:
        assert [topic.name for topic in log.topics] == ["/a", "/b"]
        assert log.damage is None


def test_channels_declared_in_a_damaged_chunk_are_used(tmp_path):
    path = write_strings_mcap(tmp_path / "a.mcap", compression=CompressionType.NONE)
    data = path.read_bytes()
    first = mcap_chunks(data)[0]
    path.write_bytes(data[: first.end - 1] + b"\xff" + data[first.end : -9])
    assert times(path) == without(*times_of_chunk(first.records))


def test_messages_of_an_unknown_channel_are_counted(tmp_path):
    path = write_strings_mcap(tmp_path / "a.mcap", use_chunking=False)
    data = path.read_bytes()
    # The channel record of /b gets an unknown opcode, here and in the summary, which makes the summary incomplete.
    path.write_bytes(data.replace(b"\x04" + data[data.index(b"\x02\0\0\0/b") - 12 :][:8], b"\x90" + bytes(8), 1)[:-9])
    record = data.index(b"\x02\0\0\0/b") - 4 - 9
    broken = bytearray(data[: data.index(b"\x0f\x04\0\0\0\0\0\0\0")])
    broken[record] = 0x90
    path.write_bytes(broken)
    outcome = read_all(path)
    assert {topic for topic, _, _ in outcome.messages} == {"/a"}
    assert "30 damaged messages were skipped" in outcome.damage


@pytest.mark.parametrize("size", [1 << 60, (1 << 64) - 1, 1 << 31, MAX_CHUNK_BYTES])
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_huge_chunk_size_allocates_no_memory(tmp_path, size, compression):
    path = write_strings_mcap(tmp_path / "a.mcap", compression=compression)
    chunk = mcap_chunks(path.read_bytes())[3]
    put(path, chunk.start + 9 + 16, struct.pack("<Q", size))
    tracemalloc.start()
    found = times(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found == without(*times_of_chunk(chunk.records))
    assert peak < 5e6


def test_a_huge_record_length_allocates_no_memory(tmp_path):
    path = write_strings_mcap(tmp_path / "a.mcap", use_chunking=False)
    data = path.read_bytes()
    place = data.index(b"\x05", 200)
    for length in (1 << 62, 1 << 32, len(data)):
        path.write_bytes(data[: place + 1] + struct.pack("<Q", length) + data[place + 9 :])
        tracemalloc.start()
        assert len(times(path)) > 10
        assert tracemalloc.get_traced_memory()[1] < 5e6
        tracemalloc.stop()


def test_a_chunk_listed_twice_in_the_summary_is_read_once(tmp_path):
    path = write_strings_mcap(tmp_path / "a.mcap", enable_crcs=False)
    data = path.read_bytes()
    chunks = mcap_chunks(data)
    path.write_bytes(data.replace(struct.pack("<Q", chunks[1].start), struct.pack("<Q", chunks[0].start)))
    assert times(path) == without()


def test_messages_between_chunks_are_read_without_being_in_the_summary(tmp_path):
    path = write_strings_mcap(tmp_path / "a.mcap", enable_crcs=False)
    data = path.read_bytes()
    chunks = mcap_chunks(data)
    body = struct.pack("<HIQQ", 1, 0, 500, 500) + b"\0\1\0\0\1\0\0\0\0"
    loose = struct.pack("<BQ", 5, len(body)) + body
    # Replaces the message indexes of the last chunk, so that all offsets stay valid.
    index_length = data.index(b"\x0f\x04\0\0\0\0\0\0\0") - chunks[-1].end
    filler = struct.pack("<BQ", 0x90, index_length - len(loose) - 9) + bytes(index_length - len(loose) - 9)
    end = chunks[-1].end
    data = data[:end] + loose + filler + data[end + index_length :]
    path.write_bytes(data.replace(struct.pack("<Q", index_length), bytes(8)))
    assert times(path) == [*without(), 500]


# --- decompression ---------------------------------------------------------------------------------------------------


def test_decompression_is_limited_by_the_compressed_size():
    assert not is_plausible_size("zstd", 100, 1 << 30)
    assert not is_plausible_size("lz4", 1 << 30, MAX_CHUNK_BYTES + 1)
    assert not is_plausible_size("brotli", 100, 100)
    assert is_plausible_size("zstd", 1000, 30_000_000)
    zeros = bytes(50_000_000)
    for name, packed in (("zstd", zstandard.compress(zeros)), ("lz4", lz4.frame.compress(zeros))):
        assert is_plausible_size(name, len(packed), len(zeros))
        tracemalloc.start()
        assert len(decompress(name, memoryview(packed), 1000)) == 1000
        assert tracemalloc.get_traced_memory()[1] < 5e6
        tracemalloc.stop()
        assert len(decompress(name, memoryview(packed), len(zeros))) == len(zeros)
        assert len(decompress(name, memoryview(packed[: len(packed) // 2]), len(zeros))) < len(zeros)
    # A frame with a size above any memory.
    liar = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 1 << 62) + bytes(20)
    assert len(decompress("zstd", memoryview(liar), 1 << 62)) == 0


# --- ROS 1 bags ------------------------------------------------------------------------------------------------------


def bag_chunks(path: Path) -> list[tuple[int, int]]:
    """(start of the data, end) of each chunk of an intact bag."""
    chunks, size = [], path.stat().st_size
    with path.open("rb") as file:
        head = read_head(file, 13, size)
        while head is not None and head.end < size:
            if head.operation == CHUNK:
                chunks.append((head.start, head.end))
            head = read_head(file, head.end, size)
    return chunks


@pytest.mark.parametrize("compression", [Rosbag1Writer.CompressionFormat.BZ2, Rosbag1Writer.CompressionFormat.LZ4])
@pytest.mark.parametrize("has_index", [True, False])
def test_a_damaged_chunk_of_a_bag_is_skipped_and_counted(tmp_path, compression, has_index):
    path = write_strings_bag(tmp_path / "a.bag", compression)
    start, end = bag_chunks(path)[2]
    put(path, start, bytes(end - start))
    if not has_index:
        path.write_bytes(path.read_bytes()[:-5])
    outcome = read_all(path)
    lost = sorted(set(without()) - {time for _, time, _ in outcome.messages})
    assert 1 < len(lost) < 20
    assert lost == list(range(lost[0], lost[-1] + 1))
    assert len(outcome.messages) + len(lost) == NUM_MESSAGES
    no_index = "" if has_index else "the bag has no index, as after a cut, and "
    times = TIMES if has_index else ""
    skipped = f"1 damaged chunk with {len(lost)} messages{times} was skipped; everything else is used{TIMES}"
    assert outcome.damage == f"{path}: {no_index}{skipped}"


@pytest.mark.parametrize("compression", [None, *Rosbag1Writer.CompressionFormat])
def test_reading_of_a_bag_resumes_at_the_next_intact_chunk(tmp_path, compression):
    path = write_strings_bag(tmp_path / "a.bag", compression)
    data = path.read_bytes()
    place = bag_chunks(path)[3][0] + 20
    path.write_bytes(data[:place] + b"garbage" + data[place:])
    outcome = read_all(path)
    assert 40 < len(outcome.messages) < NUM_MESSAGES
    assert outcome.messages[-1][1] == NUM_MESSAGES
    assert "damaged part" in outcome.damage


def test_an_encrypted_bag_is_refused(tmp_path):
    head = b"".join(
        struct.pack("<I", len(field)) + field
        for field in (b"op=\x03", b"index_pos=" + bytes(8), b"encryptor=rosbag/AesCbcEncryptor")
    )
    path = tmp_path / "a.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + struct.pack("<I", len(head)) + head + bytes(4))
    with pytest.raises(InputError, match=r"a\.bag: cannot be read: the bag is encrypted"):
        open_log(path)


# --- folders ---------------------------------------------------------------------------------------------------------


def test_a_missing_file_of_a_folder_is_named(tmp_path):
    folder = write_strings_rosbag2(tmp_path / "bag", storage="mcap")
    only = next(folder.glob("*.mcap"))
    metadata = (folder / "metadata.yaml").read_text()
    more = metadata.replace(
        "- bag.mcap", "- bag.mcap\n  - bag_1.mcap\n  - ../bag_2.mcap\n  - '..'\n  - '.'\n  - bag.mcap"
    )
    assert more != metadata
    (folder / "metadata.yaml").write_text(more)
    (folder / "bag_2.mcap").write_bytes(b"")
    outcome = read_all(folder)
    assert [time for _, time, _ in outcome.messages] == without()
    for clause in (
        "bag_1.mcap: no such file",
        "bag_2.mcap: the file is empty",
        "a folder, but",
        "everything else is used",
    ):
        assert clause in outcome.damage
    only.unlink()
    assert read_all(folder).refusal == f"{only}: no such file"


def test_a_damaged_file_of_a_folder_is_named(tmp_path):
    folder = write_strings_rosbag2(tmp_path / "bag", storage="mcap")
    file = next(folder.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:-4])
    outcome = read_all(folder)
    assert len(outcome.messages) == NUM_MESSAGES
    assert outcome.damage.startswith(f"{folder}: bag.mcap: cut after its last message")


def test_a_file_of_a_folder_is_read_from_the_time_of_its_first_message(tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    for index in range(3):
        entries = [((index * 100 + i) * 1_000_000_000, text_of(i) * 1000) for i in range(5)]
        write_strings_mcap(folder / f"rec_{index}.mcap", times_and_texts=entries, compression=CompressionType.NONE)
    with open_log(folder) as log:
        messages = log.messages(["/a"])
        seen = [next(messages) for _ in range(2)]
        assert {m.log.name for m in seen} == {"rec_0.mcap"}
        # The later files have not been read yet, so damage done now is found when their messages are due.
        (folder / "rec_2.mcap").write_bytes((folder / "rec_2.mcap").read_bytes()[:40])
        assert {m.log.name for m in messages} == {"rec_0.mcap", "rec_1.mcap"}
        assert log.damage.startswith(f"{folder}: rec_2.mcap: 3 damaged chunks")


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_a_split_recording_without_metadata_is_one_log(tmp_path, suffix):
    folder = tmp_path / "bag"
    folder.mkdir()
    for index in (0, 1, 10):
        source = write_strings_rosbag2(tmp_path / f"{index}", storage="mcap" if suffix == ".mcap" else "sqlite3")
        next(source.glob(f"*{suffix}")).rename(folder / f"rec_{index}{suffix}")
    with open_log(folder) as log:
        assert log.message_count == 3 * NUM_MESSAGES
        assert {m.log.name for m in log.messages(["/a"])} == {f"rec_{i}{suffix}" for i in (0, 1, 10)}
    (folder / f"other_0{suffix}").write_bytes(b"x")
    assert f"it holds other_0{suffix}, rec_0{suffix}" in read_all(folder).refusal


def test_damaged_compressed_messages_are_counted(tmp_path):
    from rosbags.rosbag2 import CompressionMode

    folder = write_strings_rosbag2(tmp_path / "bag", storage="mcap", mode=CompressionMode.MESSAGE)
    file = next(folder.glob("*.mcap"))
    data = file.read_bytes()
    second = data.index(b"\x28\xb5\x2f\xfd", data.index(b"\x28\xb5\x2f\xfd") + 1)
    put(file, second, b"\0\0\0\0")
    with open_log(folder) as log:
        for _ in range(2):
            assert [m.log_time_ns for m in log.messages(["/a", "/b"])] == without(2)
        assert log.damage == f"{folder}: 1 damaged message was skipped; everything else is used{TIMES}"


# --- the sentence ----------------------------------------------------------------------------------------------------


def test_the_damage_sentence_counts_skipped_parts_and_messages():
    damage = Damage()

    def sentence() -> str | None:
        return damage_sentence(Path("x.bag"), damage.clauses, None, None)

    assert sentence() is None
    damage.skip_messages("/a", 0)
    assert sentence() is None
    damage.skip_part("chunk", 7, 100)
    assert sentence() == "x.bag: 1 damaged chunk with 100 messages was skipped; everything else is used"
    damage.skip_part("chunk", 7, 100)
    damage.skip_part("chunk", 9, 18)
    assert sentence() == "x.bag: 2 damaged chunks with 118 messages were skipped; everything else is used"
    damage.skip_part("part", 9, None)
    damage.skip_messages("/a", 1)
    damage.note("cut before its end")
    assert sentence() == (
        "x.bag: cut before its end, and 3 damaged parts with at least 118 messages were skipped, "
        "and 1 damaged message was skipped; everything else is used"
    )


@pytest.mark.parametrize("has_summary", [True, False])
def test_the_damage_sentence_gives_the_log_times_of_what_is_lost_and_of_the_rest(tmp_path, has_summary):
    strings = [(1_000_000_000 * (100 + index), text) for index, (_, text) in enumerate(STRINGS)]
    path = write_strings_mcap(tmp_path / "a.mcap", times_and_texts=strings, compression=CompressionType.NONE)
    data = path.read_bytes()
    chunks = mcap_chunks(data)
    for chunk in chunks[2], chunks[4]:
        put(path, chunk.end - 12, bytes([data[chunk.end - 12] ^ 0x10]))
    if not has_summary:
        path.write_bytes(path.read_bytes()[:-20])
    first, last = chunks[2].start_ns // 10**9, chunks[4].end_ns // 10**9
    assert 100 < first < last < 159
    assert read_all(path).damage.endswith(
        f" messages (log times {first}.000 s to {last}.000 s) were skipped; everything else is used (log times"
        " 100.000 s to 159.000 s)"
    )
