"""Small files and packets that declare or decompress to gigabytes."""

from __future__ import annotations

import bz2
import io
import sqlite3
import struct
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard

from octoreplay.config.yaml_file import dump_yaml
from octoreplay.io.results.result_writer import ResultWriter
from support.packet_format import CHAIN, forged, words_of
from support.result_factory import START, state, summary, team, tick_metrics

MCAP_MAGIC = b"\x89MCAP0\r\n"
GIGABYTE = 1 << 30


def packet(depth: int, *, kind: int = 0, num_classes: int = 2, resolution: float = 0.25) -> bytes:
    """A packet of 8 leaves in which the classes differ; each is a cube of 2^(18 - depth) cells."""
    words = words_of(*CHAIN[:depth], 0xFFFF)
    payload = words + bytes(32) + bytes([1] * 8 * -(-num_classes // 8))
    counts = (depth + 1, 8, 8, 8 * -(-num_classes // 8))
    payload += bytes(4 * counts[3])
    version = (0, 0, 1, 1) if kind else (0, 0, 0, 0)
    return forged(
        payload, kind=kind, num_classes=num_classes, resolution=resolution, map_version=version, counts=counts
    )


def declared_packet(count: int) -> bytes:
    """A packet whose header declares ``count`` leaves, with a payload that a zstd frame of zeros holds."""
    payload = zeros("zstd", min(count * 2, GIGABYTE))
    return forged(payload, compression=1, counts=(1, count, 0, 0))


def zeros(compression: str, size: int) -> bytes:
    """Compressed zeros."""
    if compression == "bz2":
        return bz2.compress(bytes(size))
    if compression == "lz4":
        return bytes(lz4.frame.compress(bytes(size), store_size=True))
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=size)
    pieces = [packer.compress(bytes(min(1 << 24, size - at))) for at in range(0, size, 1 << 24)]
    return b"".join([*pieces, packer.flush()])


def record(opcode: int, body: bytes) -> bytes:
    """An MCAP record."""
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk(compression: str, data: bytes, size: int) -> bytes:
    """A chunk record of compressed data."""
    head = struct.pack("<QQQI", 1, 2, size, 0) + struct.pack("<I", len(compression)) + compression.encode()
    return record(6, head + struct.pack("<Q", len(data)) + data)


def mcap(*records: bytes) -> bytes:
    """An MCAP file without summary."""
    footer = record(15, bytes(4)) + record(2, bytes(20))
    return MCAP_MAGIC + record(1, bytes(8)) + b"".join(records) + footer + MCAP_MAGIC


def chunks_of_zeros(compression: str, size: int, most: int = 950_000) -> bytes:
    """A log of chunks that decompress to zeros, of ``most`` bytes."""
    one = chunk(compression, zeros(compression, size), size)
    return mcap(*[one] * max(1, min(most // len(one), 2000)))


def tiny_messages(num_bytes: int) -> bytes:
    """A log of one chunk with messages of no bytes."""
    name = struct.pack("<I", 2) + b"/a"
    text = struct.pack("<I", 19) + b"std_msgs/msg/String" + struct.pack("<I", 7) + b"ros2msg"
    definition = b"string data\n"
    head = record(3, struct.pack("<H", 1) + text + struct.pack("<I", len(definition)) + definition)
    head += record(4, struct.pack("<HH", 1, 1) + name + struct.pack("<I", 3) + b"cdr" + bytes(4))
    message = record(5, struct.pack("<HIQQ", 1, 0, START, START))
    content = head + message * (num_bytes // len(message))
    return mcap(chunk("zstd", zstandard.ZstdCompressor(level=1).compress(content), len(content)))


def png(width: int, height: int) -> bytes:
    """A PNG of zeros of 16 bits, whose pixels are compressed row by row."""

    def part(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    row = bytes(2 * width + 1)
    pixels = b"".join([*(packer.compress(row) for _ in range(height)), packer.flush()])
    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", pixels) + part(b"IEND", b"")


def tiff(width: int, height: int) -> bytes:
    """A TIFF that declares its size, with one empty strip."""
    entries = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 16), (259, 3, 1, 8), (262, 3, 1, 1),
               (273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, 4)]  # fmt: skip
    content = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0" + struct.pack("<I", 12) + bytes(4) + struct.pack("<H", len(entries)) + content + bytes(4)


def npz(num_bytes: int) -> bytes:
    """A world.npz of zeros."""
    file = io.BytesIO()
    keys = np.zeros((num_bytes // 24, 3), np.int64)
    np.savez_compressed(file, keys=keys, class_ids=np.zeros(len(keys), np.uint8), resolution=0.25)
    return file.getvalue()


def database(path: Path, statement: str) -> Path:
    """A database of rosbag2 whose messages are computed."""
    with sqlite3.connect(path) as connection:
        connection.executescript(
            "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);"
            "INSERT INTO schema VALUES(3, 'humble');"
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
            " offered_qos_profiles TEXT);"
            "INSERT INTO topics VALUES(1, '/a', 'std_msgs/msg/String', 'cdr', '');" + statement
        )
    connection.close()
    return path


VIEW = (
    "CREATE VIEW messages AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)"
    " SELECT x AS id, 1 AS topic_id, x AS timestamp, zeroblob(100000000) AS data FROM n;"
)
GENERATED = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
    " data BLOB AS (zeroblob(900000000)));" + "".join(f"INSERT INTO messages VALUES({n}, 1, {n});" for n in range(9))
)


def result(folder: Path, packets: list[bytes]) -> Path:
    """A result whose robot has these states, a key frame and deltas, with valid checksums."""
    folder.mkdir(exist_ok=True)
    path = folder / "result.mcap"
    metrics = [tick_metrics(tick) for tick in range(1, len(packets) + 1)]
    with ResultWriter(path, team(folder)) as writer:
        for number, (tick, data) in enumerate(zip(metrics, packets, strict=True)):
            writer.write_metrics(tick)
            writer.write_state(state("alpha", number, tick.tick, data, key=number == 0))
        writer.complete(summary(metrics))
    return path


def aliases() -> str:
    """A YAML text whose aliases repeat 10^9 numbers."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 9)]
    return "\n".join(lines)


def pcd(num_points: int, data: bytes) -> bytes:
    """A compressed PCD file that declares its number of points."""
    head = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {num_points}\nHEIGHT 1\nPOINTS {num_points}\nDATA binary_compressed\n"
    )
    return head.encode() + struct.pack("<II", len(data), min(12 * num_points, 2**32 - 1)) + data


def ply(num_vertices: int, *, is_text: bool) -> bytes:
    """A PLY file that declares its number of vertices."""
    kind = "ascii" if is_text else "binary_little_endian"
    return f"ply\nformat {kind} 1.0\nelement vertex {num_vertices}\nproperty float x\nend_header\n".encode()


def team_text(**changes: object) -> str:
    """A team file of one robot."""
    return dump_yaml({"robots": [{"id": "r", "log": "a.mcap", **changes}]})
