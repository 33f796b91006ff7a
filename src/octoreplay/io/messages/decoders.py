"""Decoding of serialised messages by the definitions in their log: ROS 2 (CDR), ROS 1, protobuf and JSON."""

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
from octoreplay.io.messages import livox
from octoreplay.io.messages.ros_types import typestore

Bytes: TypeAlias = bytes | bytearray | memoryview
Decoder: TypeAlias = Callable[[Bytes], Any]

ENCODINGS = ("cdr", "ros1", "protobuf", "json")
"""Message encodings that can be decoded."""

ROS_FORMATS = ("ros1msg", "ros2msg", "ros2idl")
"""Formats of ROS message definitions."""

# Exceptions of the decoders for bytes that do not fit the type. rosbags' generated code raises assertion and index
# errors on damaged input, and JSON may be nested too deeply.
_DAMAGED = (SerdeError, DecodeError, AssertionError, IndexError, OverflowError, MemoryError, ValueError, RecursionError)
# rosbags compiles a definition to Python code, which is a SyntaxError where a type's name is damaged.
_UNDEFINED = (KeyError, TypesysError, McapError, TypeError, DecodeError, ValueError, SyntaxError, RecursionError)

_MAX_PARTS = 10_000
"""Greatest number of parts of a message in fixed-length arrays; a definition with more is damage. rosbags generates
code for each part. An Odometry has two arrays of 36 numbers, which count as one part each."""


class DamagedMessageError(InputError):
    """The bytes of one message do not fit its type; other messages of the log may be intact."""


class UndefinedTypeError(InputError):
    """The definition of a message type is missing or cannot be parsed."""


def decode(data: Bytes, type_name: str, encoding: str, definition_format: str, definition: bytes) -> Any:
    """Return a message as an object with the fields of its definition; arrays are views of ``data``.

    ``definition`` is the type's definition in the log, in the language ``definition_format`` (``ros2msg``,
    ``protobuf``, ...). It may be empty for ROS types that this package knows. JSON objects become namespaces.
    Raises DamagedMessageError where the bytes do not fit the type, UndefinedTypeError for an unknown type or encoding.
    """
    try:
        decoder = _decoder(type_name, encoding, definition_format, definition)
    except _UNDEFINED as error:
        raise UndefinedTypeError(f"the definition of type '{type_name}' cannot be parsed") from error
    try:
        return decoder(data)
    except _DAMAGED as error:
        detail = f": {error}" if isinstance(error, SerdeError | DecodeError) else ""
        raise DamagedMessageError(f"damaged {type_name}{detail}") from error
    except (KeyError, TypesysError) as error:
        raise UndefinedTypeError(f"the definition of type '{type_name}' is unknown") from error


@cache
def _decoder(type_name: str, encoding: str, definition_format: str, definition: bytes) -> Decoder:
    """Return the decoder of a type by its definition in the log, or by a built-in one where the log has none."""
    if encoding == "protobuf":
        return _protobuf_decoder(type_name, definition)
    if encoding == "json":
        return _decode_json
    if encoding not in ENCODINGS:
        raise UndefinedTypeError(
            f"message encoding '{encoding}' is not supported; supported are {', '.join(ENCODINGS)}"
        )
    if type_name in livox.TYPES:
        livox.check_definition(definition.decode("utf-8", "replace"))
        return lambda data: livox.decode_custom_msg(memoryview(data), is_ros1=encoding == "ros1")
    store = _store(type_name, encoding, definition_format, definition.decode("utf-8", "replace"))
    deserialise = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    # rosbags' annotation allows only bytes and memoryview; any buffer works.
    return lambda data: deserialise(memoryview(data), type_name)


def _protobuf_decoder(type_name: str, definition: bytes) -> Decoder:
    """Return the decoder of a protobuf type from its FileDescriptorSet."""
    schema = Schema(id=1, data=definition, encoding="protobuf", name=type_name)
    decoder = DecoderFactory().decoder_for("protobuf", schema)
    if decoder is None:
        raise UndefinedTypeError(f"the definition of type '{type_name}' is not a protobuf FileDescriptorSet")
    return lambda data: decoder(bytes(data))


def _decode_json(data: Bytes) -> Any:
    """Parse a JSON text; objects become namespaces."""
    return json.loads(bytes(data), object_hook=lambda fields: SimpleNamespace(**fields))


def _store(type_name: str, encoding: str, definition_format: str, definition: str) -> Typestore:
    """Return a type store that decodes one ROS type by its definition in the log."""
    known = typestore()
    if not definition:
        return get_typestore(Stores.ROS1_NOETIC) if encoding == "ros1" else known
    # Definitions recorded before 2011 have the Header under its old name; a field 'Header' refers to the present one.
    definition = re.sub(r"\broslib/Header\b", "std_msgs/Header", definition)
    try:
        types = _idl_types(definition) if definition_format == "ros2idl" else get_types_from_msg(definition, type_name)
    except TypesysError:
        # rosbags does not parse all of IDL. ROS's own types are known without the definition.
        if encoding == "cdr" and type_name in known.fielddefs:
            return known
        raise
    if encoding == "cdr" and all(
        name in known.fielddefs and known.fielddefs[name][1] == fields for name, (_, fields) in types.items()
    ):
        return known
    if not 0 < _num_parts(type_name, types, ()) <= _MAX_PARTS:
        raise UndefinedTypeError(f"the definition of type '{type_name}' is empty or too large for a message")
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def _num_parts(name: str, types: Mapping[str, Any], above: tuple[str, ...]) -> int:
    """Return the least number of parts (numbers, strings, lists) of a message; a list of numbers is one part.

    ``above`` are the types that contain this one. Raises UndefinedTypeError for a list of messages without fields,
    whose length no number of bytes limits, and for a type that contains itself.
    """
    if name in above:
        raise UndefinedTypeError(f"the definition of type '{name}' contains itself")
    if name not in types:
        # Built-in types such as time, and undefined types, which decoding reports.
        return 1
    total = 0
    for _, (kind, content) in types[name][1]:
        is_list = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        (item_kind, item), length = content if is_list else ((kind, content), 1)
        parts = 1 if item_kind is Nodetype.BASE else _num_parts(item, types, (*above, name))
        if is_list and parts == 0:
            raise UndefinedTypeError(f"the definition of type '{name}' contains a list of messages without fields")
        is_unrolled = kind is Nodetype.ARRAY and (item_kind is Nodetype.NAME or item[0] == "string")
        total += parts * length if is_unrolled else 1 if is_list else parts
        if total > _MAX_PARTS:
            return total
    return total


def _idl_types(definition: str) -> Typesdict:
    """Return the types of a definition in IDL: concatenated files, each after a line of '=' and one with its name."""
    # Included files are part of the definition, and rosbags' grammar has no preprocessor directives.
    plain = re.sub(r"^[ \t]*#.*$", "", definition, flags=re.MULTILINE)
    files = re.split(r"^={80}\nIDL: .*$", plain, flags=re.MULTILINE)
    return {name: fields for file in files if file.strip() for name, fields in get_types_from_idl(file).items()}
