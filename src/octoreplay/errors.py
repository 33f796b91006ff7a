"""The errors that octoreplay raises on purpose.

::

    OctoreplayError           one sentence: what, where, what to do
    +-- InputError            a log, a result or a data folder cannot be used        (exit code 1)
    +-- OutputError           a file cannot be written                               (exit code 1)
    +-- ConfigError           an option, a team file or a parameter is wrong         (exit code 2)
    +-- PacketError           bytes that are not a map packet this version can read  (exit code 1)
"""

import difflib
import re
from collections.abc import Iterable


class OctoreplayError(Exception):
    """Base of all errors that octoreplay raises on purpose; its text is one sentence for the user."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(text))


class InputError(OctoreplayError):
    """A log, a result or a data folder is missing, damaged or lacks what a run needs."""


class OutputError(OctoreplayError):
    """A file or folder cannot be written."""


class ConfigError(OctoreplayError):
    """An option, a team file or a parameter is unknown, of the wrong type or out of range."""


class PacketError(OctoreplayError):
    """Bytes that are no map packet, are damaged, or come from a newer format version."""


def printable(text: str) -> str:
    """A text for a terminal: names in logs may hold anything, and what controls a terminal is escaped as in Python.

    Lines that are indented, as candidates are, stay lines of their own.
    """
    if text.isprintable():
        return text
    escaped = "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)
    return re.sub(r"\n(?!    )", r"\\n", escaped)


def suggestion(name: str, known: Iterable[str]) -> str:
    """The end of a sentence: '; did you mean ...' with the nearest known name, or nothing."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean '{near[0]}'?" if near else ""
