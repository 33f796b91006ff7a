"""Reading and writing of YAML and JSON text, with limits on what is read and errors of one sentence."""

from __future__ import annotations

import io
import json
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octoreplay.config.fields import path_problem
from octoreplay.errors import ConfigError

if TYPE_CHECKING:
    from ruamel.yaml import YAML

MAX_BYTES = 4 << 20
"""Largest size of a configuration file [byte]."""
MAX_DEPTH = 32
"""Largest number of nested lists and mappings in YAML."""
MAX_NODES = 50_000
"""Largest number of keys, values, lists and mappings in YAML. An alias counts as all that it repeats."""
MAX_SCALAR = 100_000
"""Largest length of one key or value in YAML [character]."""

_SURROGATE = re.compile("[\ud800-\udfff]")
"""Halves of surrogate pairs, which escapes can make, but UTF-8 cannot hold."""


def read_text(path: Path, kind: str) -> str:
    """Return the text of a configuration file.

    Raises ConfigError if it is unreadable, larger than ``MAX_BYTES`` or not UTF-8.
    """
    problem = path_problem(path)
    if problem is not None:
        raise ConfigError(f"{path}: cannot be read: {problem}")
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{path}: not a {kind} file: it is larger than {MAX_BYTES >> 20} MB")
    try:
        # As in text files, every line ends with a line feed.
        return data.decode().replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a {kind} file: its text is not UTF-8") from error


def load_yaml(text: str, name: str, max_nodes: int = MAX_NODES) -> Any:
    """Return the content of a YAML text, built of plain values.

    Raises ConfigError that starts with ``name`` for text that is not valid, and for text beyond ``MAX_DEPTH``,
    ``max_nodes`` or ``MAX_SCALAR``.
    """
    from ruamel.yaml.error import YAMLError

    try:
        with warnings.catch_warnings():
            # ruamel.yaml warns of anchors that are given twice, which YAML allows.
            warnings.simplefilter("ignore")
            return _bounded_yaml(max_nodes).load(text)
    except YAMLError as error:
        line = getattr(getattr(error, "problem_mark", None), "line", None)
        where = "" if line is None else f" (line {line + 1})"
        raise ConfigError(f"{name}: not valid YAML{where}: {getattr(error, 'problem', None) or error}") from error
    except (ValueError, OverflowError) as error:
        # The scanner converts the numbers of escapes and directives without a check.
        raise ConfigError(f"{name}: not valid YAML: {error}") from error


def load_json(text: str | bytes, name: str) -> Any:
    """Return the content of a JSON text. Raises ConfigError that starts with ``name`` for text that is not valid."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ConfigError(f"{name}: not valid JSON: it is nested too deeply") from error
    except ValueError as error:
        raise ConfigError(f"{name}: not valid JSON: {error}") from error


def dump_yaml(content: Mapping[str, Any], *, in_blocks: bool = False) -> str:
    """Return the text of a mapping as YAML in its own order of keys.

    The innermost lists and mappings take one line, with ``in_blocks`` a line for each entry.
    """
    from ruamel.yaml import YAML

    buffer = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False if in_blocks else None
    yaml.representer.sort_base_mapping_type_on_output = False
    yaml.width = 110
    yaml.dump(content, buffer)
    return buffer.getvalue()


def _bounded_yaml(max_nodes: int) -> YAML:
    """Return a YAML loader that checks the limits before it builds values, and names the line of a wrong one."""
    from ruamel.yaml import YAML
    from ruamel.yaml.composer import Composer, ComposerError
    from ruamel.yaml.constructor import ConstructorError, SafeConstructor
    from ruamel.yaml.events import AliasEvent, ScalarEvent

    class BoundedComposer(Composer):
        """Composer of at most ``max_nodes`` nodes."""

        def __init__(self, loader: Any = None) -> None:
            super().__init__(loader)
            self._num_nodes = 0
            self._sizes: dict[str, int] = {}

        def compose_node(self, parent: Any, index: Any) -> Any:
            event = self.parser.peek_event()
            mark, before = event.start_mark, self._num_nodes
            if isinstance(event, AliasEvent):
                if event.anchor in self.anchors and event.anchor not in self._sizes:
                    raise ComposerError(None, None, f"the alias '{event.anchor}' contains itself", mark)
                self._num_nodes += self._sizes.get(event.anchor, 0)
            elif isinstance(event, ScalarEvent):
                if len(event.value) > MAX_SCALAR:
                    raise ComposerError(None, None, f"a value has more than {MAX_SCALAR:,} characters", mark)
                if _SURROGATE.search(event.value):
                    raise ComposerError(None, None, "a value has half a surrogate pair", mark)
            self._num_nodes += 1
            if self.depth >= MAX_DEPTH:
                raise ComposerError(None, None, f"it is nested more than {MAX_DEPTH} levels deep", mark)
            if self._num_nodes > max_nodes:
                raise ComposerError(None, None, f"it has more than {max_nodes:,} keys and values", mark)
            if not isinstance(event, AliasEvent):
                self._sizes.pop(event.anchor, None)
            node = super().compose_node(parent, index)
            if event.anchor is not None and not isinstance(event, AliasEvent):
                self._sizes[event.anchor] = self._num_nodes - before
            return node

    class PlaceConstructor(SafeConstructor):
        """Constructor of plain values whose errors have a line."""

        def construct_object(self, node: Any, deep: bool = False) -> Any:
            try:
                value = super().construct_object(node, deep=deep)
            except (ValueError, TypeError, ArithmeticError, LookupError, AttributeError) as error:
                kind = str(getattr(node.tag, "value", node.tag)).rpartition(":")[2]
                shown = f"'{node.value[:40]}'" if isinstance(node.value, str) else "a list or mapping"
                raise ConstructorError(None, None, f"{shown} is not a valid {kind}", node.start_mark) from error
            if isinstance(value, int) and not -(1 << 63) <= value < 1 << 63:
                raise ConstructorError(None, None, f"'{node.value[:40]}' is beyond 64 bits", node.start_mark)
            return value

    yaml = YAML(typ="safe", pure=True)
    yaml.Composer = BoundedComposer
    yaml.Constructor = PlaceConstructor
    return yaml
