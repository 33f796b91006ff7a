"""Serialised bytes to message objects: ROS 2 (cdr), ROS 1, protobuf and JSON, each by the definition in its log."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from functools import cache
from types import SimpleNamespace
from typing import Any, TypeAlias

from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from octoreplay.errors import InputError
from octoreplay.io.messages.ros_types import typestore

Bytes: TypeAlias = bytes | bytearray | memoryview
Decoder: TypeAlias = Callable[[Bytes], Any]

ENCODINGS = ("cdr", "ros1", "protobuf", "json")
"""Message encodings that can be decoded."""

ROS_FORMATS = ("ros1msg", "ros2msg", "ros2idl")
"""Formats of ROS message definitions."""

# What the decoders raise for bytes that do not fit their type. On damaged input rosbags' generated code lets its
# assertions and index errors through, and JSON may nest too deeply.
_DAMAGED = (SerdeError, DecodeError, AssertionError, IndexError, OverflowError, MemoryError, ValueError, RecursionError)
# rosbags writes a definition as Python code, which is none where a type's name is damaged.
_UNDEFINED = (KeyError, TypesysError, McapError, TypeError, DecodeError, ValueError, SyntaxError, RecursionError)

_MAX_PARTS = 10_000
"""A definition whose arrays of a fixed length have more parts than this in one message is damage: rosbags writes each
of them as lines of code. An odometry has two arrays of 36 numbers, which count as one part each."""


class DamagedMessageError(InputError):
    """One message whose bytes do not hold what its type says; the messages around it may be good."""


class UndefinedTypeError(InputError):
    """A message type whose definition is missing, or cannot be understood."""


def decode(data: Bytes, type_name: str, encoding: str, definition_format: str, definition: bytes) -> Any:
    """The message object of serialised bytes: attributes are named as in its definition, arrays are views of ``data``.

    ``definition`` is the type's definition as the log holds it, in ``definition_format`` (``ros2msg``, ``protobuf``,
    ...); empty for a ROS type that this package knows. JSON objects become namespaces.
    Raises DamagedMessageError where the bytes do not fit the type, UndefinedTypeError for an unknown type or encoding.
    """
    try:
        decoder = _decoder(type_name, encoding, definition_format, definition)
    except _UNDEFINED as error:
        raise UndefinedTypeError(f"the definition of type '{type_name}' cannot be understood") from error
    try:
        return decoder(data)
    except _DAMAGED as error:
        detail = f": {error}" if isinstance(error, SerdeError | DecodeError) else ""
        raise DamagedMessageError(f"damaged {type_name}{detail}") from error
    except (KeyError, TypesysError) as error:
        raise UndefinedTypeError(f"the definition of type '{type_name}' is unknown") from error


@cache
def _decoder(type_name: str, encoding: str, definition_format: str, definition: bytes) -> Decoder:
    """The decoder of a type as the log defines it, or as this package knows it where the log says nothing."""
    if encoding == "protobuf":
        return _protobuf_decoder(type_name, definition)
    if encoding == "json":
        return _decode_json
    if encoding not in ENCODINGS:
        raise UndefinedTypeError(f"message encoding '{encoding}' is not supported; {', '.join(ENCODINGS)} are")
    store = _store(type_name, encoding, definition_format, definition.decode("utf-8", "replace"))
    deserialise = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    # rosbags annotates only bytes and memoryview, and takes any buffer.
    return lambda data: deserialise(memoryview(data), type_name)


def _protobuf_decoder(type_name: str, definition: bytes) -> Decoder:
    """The decoder of a protobuf type from its FileDescriptorSet."""
    schema = Schema(id=1, data=definition, encoding="protobuf", name=type_name)
    decoder = DecoderFactory().decoder_for("protobuf", schema)
    if decoder is None:
        raise UndefinedTypeError(f"the definition of type '{type_name}' is no protobuf definition")
    return lambda data: decoder(bytes(data))


def _decode_json(data: Bytes) -> Any:
    """A JSON text; objects become namespaces."""
    return json.loads(bytes(data), object_hook=lambda fields: SimpleNamespace(**fields))


def _store(type_name: str, encoding: str, definition_format: str, definition: str) -> Typestore:
    """A type store that decodes one ROS type the way the log's own definition says."""
    known = typestore()
    if not definition:
        return get_typestore(Stores.ROS1_NOETIC) if encoding == "ros1" else known
    try:
        types = _idl_types(definition) if definition_format == "ros2idl" else get_types_from_msg(definition, type_name)
    except TypesysError:
        # rosbags does not understand all of IDL; ROS's own types are what they are.
        if encoding == "cdr" and type_name in known.fielddefs:
            return known
        raise
    if encoding == "cdr" and all(
        name in known.fielddefs and known.fielddefs[name][1] == fields for name, (_, fields) in types.items()
    ):
        return known
    if not 0 < _num_parts(type_name, types, ()) <= _MAX_PARTS:
        raise UndefinedTypeError(f"the definition of type '{type_name}' cannot be that of a message")
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def _num_parts(name: str, types: Mapping[str, Any], above: tuple[str, ...]) -> int:
    """How many numbers, strings and lists a message has at least, a list of numbers being one of them; 0 without any.

    Raises UndefinedTypeError for a list of messages that take no bytes, which could be as long as it claims, and for a
    type that holds itself. ``above`` are the types around it.
    """
    if name in above:
        raise UndefinedTypeError(f"the definition of type '{name}' holds itself")
    if name not in types:
        # Built in, as times are, or not defined, which decoding says.
        return 1
    total = 0
    for _, (kind, content) in types[name][1]:
        is_list = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        (item_kind, item), length = content if is_list else ((kind, content), 1)
        parts = 1 if item_kind is Nodetype.BASE else _num_parts(item, types, (*above, name))
        if is_list and parts == 0:
            raise UndefinedTypeError(f"the definition of type '{name}' holds a list of nothing")
        is_unrolled = kind is Nodetype.ARRAY and (item_kind is Nodetype.NAME or item[0] == "string")
        total += parts * length if is_unrolled else 1 if is_list else parts
        if total > _MAX_PARTS:
            return total
    return total


def _idl_types(definition: str) -> Typesdict:
    """The types of a definition in IDL: files one after the other, each after a line of '=' and one with its name."""
    # What the files include stands beside them, and rosbags' grammar has no directives.
    plain = re.sub(r"^[ \t]*#.*$", "", definition, flags=re.MULTILINE)
    files = re.split(r"^={80}\nIDL: .*$", plain, flags=re.MULTILINE)
    return {name: fields for file in files if file.strip() for name, fields in get_types_from_idl(file).items()}
