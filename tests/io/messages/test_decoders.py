from __future__ import annotations

import re
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from octoreplay.errors import InputError
from octoreplay.io.messages.decoders import DamagedMessageError, UndefinedTypeError, decode
from support.log_factory import (
    FOXGLOVE_ENCODINGS,
    SECOND,
    Entry,
    Factory,
    Row,
    foxglove_row,
    foxglove_stamp,
    foxglove_transform,
    ros1_row,
    ros2,
    ros_row,
)
from support.long_suite import examples

ODOMETRY = Entry("/odom", "nav_msgs/msg/Odometry", ros2.odometry(5 * SECOND, (1, 2, 3)), 0)
IMAGE = Entry("/image", "sensor_msgs/msg/Image", ros2.image(5, np.ones((2, 3), np.uint16), "16UC1"), 0)
CLOUD = Entry("/cloud", "sensor_msgs/msg/PointCloud2", ros2.cloud(5, {"x": np.ones(3, "f4")}), 0)
LABELS = Entry("/info", "vision_msgs/msg/LabelInfo", ros2.label_info(5, {1: "a"}), 0)
ros1 = Factory(ros1=True)
ODOMETRY_1 = Entry("/odom", "nav_msgs/msg/Odometry", ros1.odometry(5 * SECOND, (1, 2, 3)), 0)
RAW_IMAGE = {
    "timestamp": foxglove_stamp(5), "frame_id": "a", "width": 1, "height": 1, "encoding": "mono8", "step": 1,
    "data": b"a",
}  # fmt: skip

ROWS = [
    *(ros_row(entry) for entry in (ODOMETRY, IMAGE, CLOUD, LABELS)),
    ros1_row(ODOMETRY_1),
    *(foxglove_row("/image", "RawImage", RAW_IMAGE, 0, encoding) for encoding in FOXGLOVE_ENCODINGS),
    *(
        foxglove_row(
            "/tf", "FrameTransforms", {"transforms": [foxglove_transform("a", "b", 5, (1, 0, 0))]}, 0, encoding
        )
        for encoding in FOXGLOVE_ENCODINGS
    ),
]


def decode_row(row: Row, data: bytes | None = None):
    data = row.data if data is None else data
    return decode(data, row.message().type_name, row.encoding, row.schema_encoding, row.schema)


def problem_of(read: Callable[[], object], kind: type[InputError] = InputError) -> str:
    """Return the error message of ``read``; empty without an error."""
    try:
        read()
    except kind as error:
        return str(error)
    return ""


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.schema_name} {row.encoding}")
@pytest.mark.parametrize("as_type", [bytes, bytearray, memoryview])
def test_any_buffer_is_decoded(row, as_type):
    assert decode_row(row, as_type(row.data)) is not None


def test_arrays_are_views_of_the_bytes():
    row = ros_row(IMAGE)
    data = np.frombuffer(row.data, np.uint8)
    assert np.shares_memory(decode_row(row, data.data).data, data)


@pytest.mark.parametrize(("entry", "make_row"), [(ODOMETRY, ros_row), (ODOMETRY_1, ros1_row)])
def test_a_known_type_needs_no_definition(entry, make_row):
    row = make_row(entry)
    value = decode(row.data, entry.type_name, row.encoding, "", b"")
    assert value.pose.pose.position.y == 2.0
    assert value.child_frame_id == "base_link"


def test_the_definition_in_the_log_has_precedence_over_the_built_in_one():
    definition = b"uint8 more\nstring child_frame_id\n"
    value = decode(b"\0\1\0\0\7\0\0\0\2\0\0\0a\0", "nav_msgs/msg/Odometry", "cdr", "ros2msg", definition)
    assert (value.more, value.child_frame_id) == (7, "a")


@pytest.mark.parametrize(
    ("encoding", "definition_format", "definition", "sentence"),
    [
        ("cbor", "", b"", "message encoding 'cbor' is not supported; supported are cdr, ros1, protobuf, json"),
        ("cdr", "ros2msg", b"", "the definition of type 'a/msg/B' is unknown"),
        ("ros1", "ros1msg", b"", "the definition of type 'a/msg/B' is unknown"),
        ("cdr", "ros2msg", b"\xff\xfe\0 nonsense {", "the definition of type 'a/msg/B' cannot be parsed"),
        ("cdr", "ros2msg", b"other/Missing x\n", "the definition of type 'a/msg/B' "),
        ("cdr", "ros2idl", b"module {", "the definition of type 'a/msg/B' cannot be parsed"),
        ("ros1", "ros1msg", b"float99 x\n", "the definition of type 'a/msg/B' "),
        ("protobuf", "protobuf", b"", "the definition of type 'a/msg/B' "),
        ("protobuf", "protobuf", b"\x0a\x05hello", "the definition of type 'a/msg/B' "),
        ("protobuf", "protobuf", b"garbage", "the definition of type 'a/msg/B' "),
    ],
)
def test_types_without_a_usable_definition_are_named(encoding, definition_format, definition, sentence):
    with pytest.raises(UndefinedTypeError, match=f"^{re.escape(sentence)}"):
        decode(b"\0" * 64, "a/msg/B", encoding, definition_format, definition)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.schema_name} {row.encoding}")
def test_cut_bytes_are_damage_or_a_shorter_message(row):
    """Protobuf messages have no length, so a cut between two fields gives a shorter message."""
    for size in range(len(row.data)):
        problem = problem_of(lambda size=size: decode_row(row, row.data[:size]), DamagedMessageError)
        assert problem.startswith(f"damaged {row.message().type_name}") or (
            problem == "" and row.encoding == "protobuf"
        )


@given(st.sampled_from(ROWS), st.integers(0, 10**6), st.binary(min_size=1, max_size=12), st.booleans())
@examples(600)
def test_changed_bytes_raise_only_input_errors(row, position, noise, is_definition):
    source = bytearray(row.schema if is_definition else row.data)
    position %= len(source)
    source[position : position + len(noise)] = noise
    if is_definition:
        row = row._replace(schema=bytes(source))
    message = (row if is_definition else row._replace(data=bytes(source))).message()
    for read in (message.decode, message.sensor_message):
        assert problem_of(read)[:15] in ("", "a.mcap: topic '")


@given(st.sampled_from(ROWS), st.binary(max_size=80))
@example(ROWS[0], b"")
@examples(300)
def test_random_bytes_raise_only_input_errors(row, data):
    message = row._replace(data=data).message()
    for read in (message.decode, message.sensor_message, message.header_stamp_ns, message.header_frame_id):
        assert problem_of(read)[:15] in ("", "a.mcap: topic '")


@pytest.mark.parametrize(
    "text", [b"", b"{", b"\xff", b"nul", b'{"a": 1', b"[" * 100_000, b'{"a":' * 100_000, b"1" * 10_000, b"1e999"]
)
def test_invalid_json_is_damage(text):
    try:
        value = decode(text, "foxglove.RawImage", "json", "jsonschema", b"{}")
    except DamagedMessageError:
        return
    assert isinstance(value, float)


def test_json_objects_are_namespaces():
    value = decode(b'{"a": {"b": [1, {"c": null}]}}', "x", "json", "", b"")
    assert value.a.b == [1, SimpleNamespace(c=None)]


def test_a_json_message_that_is_not_an_object_is_damage():
    for text in (b"[]", b"3", b"null", b'"x"', b"{}"):
        row = ROWS[7]._replace(data=text)
        assert row.encoding == "json"
        for read in (row.message().sensor_message, row.message().header_stamp_ns):
            with pytest.raises(DamagedMessageError, match=r"^a\.mcap: topic '/image' at 0\.000 s: "):
                read()


EMPTY_PART = b"=" * 80 + b"\nMSG: a/E\n"


@pytest.mark.parametrize(
    "definition",
    [
        b"string[400000000] names\n",
        b"a/E[400000000] parts\n" + EMPTY_PART,
        b"a/E[400000000] parts\n" + EMPTY_PART + b"uint8 x\n",
        b"a/E[200] parts\n" + EMPTY_PART + b"string[200] names\n",
        b"a/E[] parts\n" + EMPTY_PART,
        b"a/msg/X[] parts\n",
        b"3td_msgs/Header part\n" + b"=" * 80 + b"\nMSG: 3td_msgs/Header\nuint32 a\n",
        b"",
    ],
)
def test_definitions_that_would_take_all_memory_are_refused(definition):
    definition = definition or b"# nothing\n"
    data = b"\0\1\0\0" + b"\xff" * 40
    with pytest.raises(UndefinedTypeError, match=r"definition of type '(a/msg/X|a/msg/E)'"):
        decode(data, "a/msg/X", "cdr", "ros2msg", definition)


def test_definitions_may_have_arrays_of_messages():
    definition = b"a/E[3] parts\nfloat64[9000000] numbers\n" + EMPTY_PART + b"uint8[2] x\n"
    data = b"\0\1\0\0" + bytes(range(6)) + bytes(2) + bytes(72_000_000)
    value = decode(data, "a/msg/X", "cdr", "ros2msg", definition)
    assert [part.x.tolist() for part in value.parts] == [[0, 1], [2, 3], [4, 5]]
    assert value.numbers.size == 9_000_000
