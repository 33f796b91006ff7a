"""A run of damaged logs ends with exit code 3 and one warning for each log."""

from __future__ import annotations

import shutil
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from support.command_line import octoreplay
from support.fixture_paths import PAIR
from support.log_damage import mcap_chunks


def rewrite_in_small_chunks(source: Path, target: Path) -> None:
    """The same messages with a chunk for every few of them."""
    with source.open("rb") as stream, target.open("wb") as copy:
        writer = Writer(copy, chunk_size=5000)
        writer.start("ros2")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id]
                )
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


def test_a_run_of_damaged_logs_warns_once_for_each_log(tmp_path):
    for name in ("team.yaml", "husky_2.mcap"):
        shutil.copy(PAIR / name, tmp_path / name)
    cut, damaged = tmp_path / "husky_2.mcap", tmp_path / "husky_1.mcap"
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size * 7 // 10])
    rewrite_in_small_chunks(PAIR / "husky_1.mcap", damaged)
    data = bytearray(damaged.read_bytes())
    chunks = mcap_chunks(bytes(data))
    seconds = [f"{time_ns / 1e9:.3f} s" for time_ns in (chunks[20].start_ns, chunks[25].end_ns)]
    for chunk in (chunks[20], chunks[25]):
        data[chunk.end - 3] ^= 1
    damaged.write_bytes(data)
    done = octoreplay("run", tmp_path / "team.yaml", "-o", tmp_path / "out.mcap")
    assert done.returncode == 3, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith(f"warning: {tmp_path}")]
    skipped, rest = sorted(lines)
    assert skipped.startswith(
        f"warning: {damaged}: 2 damaged chunks with 13 messages (log times {seconds[0]} to {seconds[1]}) were skipped;"
        " everything else is used (log times "
    )
    assert rest.startswith(f"warning: {cut}: cut before its end; everything else is used (log times ")
