"""Exceptions of octoreplay.

::

    OctoreplayError           one sentence: what, where, what to do
    +-- InputError            a log, a result or a data folder cannot be used        (exit code 1)
    +-- OutputError           a file cannot be written                               (exit code 1)
    +-- ConfigError           an option, a team file or a parameter is wrong         (exit code 2)
    +-- PacketError           bytes are not a map packet that this version can read  (exit code 1)
"""

import difflib
import re
from collections.abc import Iterable


class OctoreplayError(Exception):
    """Base class of octoreplay's exceptions; the text is one sentence for the user."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(text))


class InputError(OctoreplayError):
    """A log, a result or a data folder is missing, damaged or incomplete."""


class OutputError(OctoreplayError):
    """A file or folder cannot be written."""


class ConfigError(OctoreplayError):
    """An option, a team file or a parameter is unknown, of the wrong type or out of range."""


class PacketError(OctoreplayError):
    """Bytes are not a map packet, are damaged, or have another format version."""


def printable(text: str) -> str:
    """Return a text that is safe to print: names in logs may contain control characters, which are escaped.

    Line breaks before an indented line are kept, because messages list candidates in such lines.
    """
    if text.isprintable():
        return text
    escaped = "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)
    return re.sub(r"\n(?!    )", r"\\n", escaped)


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return the end of a sentence, '; did you mean ...?' with the most similar known name, or an empty string."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean '{near[0]}'?" if near else ""
