"""Mutations of files: bytes, words of texts, values of YAML and JSON, and packets and results with valid checksums."""

from __future__ import annotations

import io
import json
import random
import struct
import zlib
from copy import deepcopy
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from octoreplay.config.yaml_file import dump_yaml
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from support.log_damage import cut, flip_bits, insert, lie_about_sizes, overwrite, remove, zero_page
from support.packet_format import HEADER

WORDS = (
    "0", "-1", "1e308", "-1e308", "1e-320", "nan", "inf", "-inf", ".inf", ".nan", "99999999999999999999", "9" * 400,
    "0x10", "1_000", "2001-99-99", "2001-01-01", "!!int x", "!!float x", "!!binary x", "!!set {a}", "~", "true", "''",
    "[]", "{}", "[[[[]]]]", "*a", "&a", "a: b", "\u00e9" * 300, "a" * 300, "\x00", "\x1b[2J", "\u202e", "/", "..",
    "central", "free", "team", "18446744073709551616", "-9223372036854775809", "0.1", "255", "256", "65536",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 255, 256, 1 << 31, 1 << 62, 0.0, -0.5, 1e-320, 1e308, float("inf"), float("nan"), "",
    "x", "central", "free", "a" * 300, "\x1b[2J", "\u202e", "/", [], {}, [[]], [None], {"a": None}, [1, 2, 3],
    [0.5] * 7, ["a", "b"], [["a", "b"]], {"id": "x"}, {1: 2}, "semantickitti", "1e999", "no", "../..", "ring", "given",
)  # fmt: skip
"""Values of any type, some of them right for another key."""

_BYTES = (flip_bits, flip_bits, cut, insert, remove, overwrite, zero_page, lie_about_sizes)


def mutated(data: bytes, rng: random.Random, others: tuple[bytes, ...] = ()) -> bytes:
    """Bytes with one to three changes, among them parts of other files."""
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        if others and rng.random() < 0.15:
            other, at = rng.choice(others), rng.randrange(len(data) + 1)
            start = rng.randrange(len(other) + 1)
            data = data[:at] + other[start : start + rng.randrange(1, 400)] + data[at:]
        elif data:
            data = rng.choice(_BYTES)(data, rng)
    return data


def mutated_text(text: str, rng: random.Random, others: tuple[str, ...] = ()) -> str:
    """A text with words and lines that are changed, repeated, removed or moved."""
    for _ in range(rng.choice([1, 1, 2, 4])):
        lines = text.split("\n")
        at, kind = rng.randrange(len(lines)), rng.randrange(7)
        if kind <= 2:
            words = lines[at].split(" ")
            words[rng.randrange(len(words))] = rng.choice(WORDS)
            lines[at] = " ".join(words)
        elif kind == 3:
            lines[at:at] = lines[at : at + rng.randrange(1, 5)] * rng.choice([1, 1, 50])
        elif kind == 4:
            del lines[at : at + rng.randrange(1, 4)]
        elif kind == 5:
            lines[at] = " " * rng.randrange(9) + lines[at].lstrip()
        else:
            lines.insert(at, rng.choice(rng.choice(others or (text,)).split("\n")))
        text = "\n".join(lines)
    return text


def mutated_content(content: Any, rng: random.Random) -> Any:
    """Content of a YAML or JSON file with values that are changed, removed, renamed or moved."""
    content = deepcopy(content)
    for _ in range(rng.choice([1, 1, 2, 3])):
        places = list(_places(content))
        if not places:
            return rng.choice(VALUES)
        parent, key = rng.choice(places)
        kind = rng.randrange(6)
        if kind <= 2:
            parent[key] = deepcopy(rng.choice(VALUES))
        elif kind == 3:
            other, other_key = rng.choice(places)
            parent[key] = deepcopy(other.get(other_key) if isinstance(other, dict) else other[other_key])
        elif kind == 4:
            del parent[key]
        elif isinstance(parent, dict):
            parent[rng.choice(["x", 1, "id", "from", "name", key])] = parent.pop(key)
        else:
            parent += parent[:3]
    return content


def _places(content: Any) -> Any:
    """(Parent, key) of every value."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        yield content, key
        yield from _places(value)


def mutated_yaml(content: Any, text: str, rng: random.Random, others: tuple[str, ...]) -> str:
    """A YAML text with changed values, words or bytes."""
    kind = rng.random()
    if kind < 0.6:
        changed = mutated_content(content, rng)
        try:
            return dump_yaml(changed)
        except Exception:
            # Not all values can be written.
            return json.dumps(changed, default=str)
    if kind < 0.9:
        return mutated_text(text, rng, others)
    return mutated(text.encode(), rng, tuple(other.encode() for other in others)).decode("utf-8", "replace")


def mutated_packet(data: bytes, rng: random.Random, others: tuple[bytes, ...]) -> bytes:
    """A packet with a changed header or payload and, mostly, a valid size and checksum."""
    size = struct.calcsize(HEADER)
    fields = list(struct.unpack(HEADER, data[:size]))
    payload = mutated(data[size:], rng, others) if rng.random() < 0.7 else data[size:]
    for _ in range(rng.choice([0, 1, 2])):
        index = rng.randrange(2, len(fields) - 2)
        value = fields[index]
        if isinstance(value, float):
            fields[index] = rng.choice([0.0, -1.0, 0.05, 1e-30, 1e30, float("nan"), float("inf")])
        else:
            bits = 8 * struct.calcsize("<" + HEADER[1:].replace("4s", "s")[index])
            fields[index] = rng.choice([0, 1, 2, value + 1, value - 1, 2 * value, 1 << (bits - 1), (1 << bits) - 1])
    fields[-2] = len(payload)
    try:
        head = struct.pack(HEADER, *fields[:-1], 0)
    except struct.error:
        return mutated(data, rng, others)
    if rng.random() < 0.1:
        return mutated(data, rng, others)
    return struct.pack(HEADER, *fields[:-1], zlib.crc32(payload, zlib.crc32(head))) + payload


def mutated_result(data: bytes, rng: random.Random, path: Path) -> None:
    """Write a result with changed metadata or messages and valid checksums, or with changed bytes."""
    if rng.random() < 0.3:
        path.write_bytes(mutated(data, rng))
        return
    reader = make_reader(io.BytesIO(data))
    metadata = [(record.name, dict(record.metadata)) for record in reader.iter_metadata()]
    messages = list(reader.iter_messages(log_time_order=False))
    packets = tuple(message.data for _, _, message in messages)
    is_metadata = rng.random() < 0.5
    if is_metadata:
        name, values = rng.choice(metadata)
        values.pop("crc32", None)
        _change_values(values, rng)
        if rng.random() < 0.1:
            metadata = [entry for entry in metadata if entry[0] != name]
    for _ in range(0 if is_metadata else rng.choice([1, 1, 3])):
        schema, channel, message = messages[rng.randrange(len(messages))]
        kind = rng.randrange(4)
        if kind <= 1:
            message.data = _changed_message(message.data, rng, packets)
        elif kind == 2:
            message.log_time = rng.choice([0, (1 << 63) - 1, (1 << 64) - 1, message.log_time + 10**9])
        else:
            messages.append((schema, channel, message))
    path.unlink(missing_ok=True)
    with RosMcapWriter(path, data_crc=True) as writer:
        for name, values in metadata:
            values.pop("crc32", None)
            writer.write_metadata(name, values)
        for schema, channel, message in messages:
            writer.copy(schema, channel, message)


def _change_values(values: dict[str, str], rng: random.Random) -> None:
    """Change a value of a metadata record: as JSON, as text, or without it."""
    if not values:
        return
    key = rng.choice(list(values))
    text, kind = values[key], rng.randrange(5)
    if kind == 0:
        del values[key]
    elif kind <= 2:
        try:
            values[key] = json.dumps(mutated_content(json.loads(text), rng))
        except ValueError:
            values[key] = mutated_text(text, rng)
    elif kind == 3:
        values[key] = rng.choice([*WORDS, "[" * 5000, "{" * 900, "", "null", '{"a":' * 2000])
        values[key] = values[key].replace("\x00", "")
    else:
        values[key] = mutated_text(text, rng)


def _changed_message(data: bytes, rng: random.Random, others: tuple[bytes, ...]) -> bytes:
    """Bytes of a message with changes; packets in it may have a valid checksum."""
    at = data.find(b"OCTM")
    if at < 0 or rng.random() < 0.2:
        return mutated(data, rng, others)
    packet = mutated_packet(data[at:], rng, others)
    return data[: at - 4] + struct.pack("<I", len(packet)) + packet
