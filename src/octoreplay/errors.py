"""Exceptions of octoreplay.

::

    OctoreplayError           one sentence: what, where, what to do
    +-- InputError            a log, a result or a data folder cannot be used        (exit code 1)
    +-- OutputError           a file cannot be written                               (exit code 1)
    +-- ConfigError           an option, a team file or a parameter is wrong         (exit code 2)
    +-- PacketError           bytes are not a map packet that this version can read  (exit code 1)
    +-- MemoryLimitError      a run takes more memory than it may                    (exit code 1)
"""

import difflib
import re
from collections.abc import Iterable
from typing import Final


class OctoreplayError(Exception):
    """Base class of octoreplay's exceptions; the text is one sentence for the user."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(shortened(text)))


class InputError(OctoreplayError):
    """A log, a result or a data folder is missing, damaged or incomplete."""


class OutputError(OctoreplayError):
    """A file or folder cannot be written."""


class ConfigError(OctoreplayError):
    """An option, a team file or a parameter is unknown, of the wrong type or out of range."""


class PacketError(OctoreplayError):
    """Bytes are not a map packet, are damaged, or have another format version."""


class MemoryLimitError(OctoreplayError):
    """A run takes more memory than its limit."""


EARLY: Final = {"is_early": True}
"""``extra`` of a logged warning that a command prints at once, since it is useful only while the command runs."""

LONGEST_ERROR = 4000
"""Largest length of an exception's text; the middle of longer ones is left out [characters]."""


def shortened(text: str) -> str:
    """Return a text of at most about ``LONGEST_ERROR`` characters: wrong values of files may have any length."""
    half = LONGEST_ERROR // 2
    return text if len(text) <= LONGEST_ERROR else f"{text[:half]} ... {text[-half:]}"


def printable(text: str) -> str:
    """Return a sentence that is safe to print, with ``escaped`` characters.

    Line breaks before an indented line are kept, because messages list candidates in such lines.
    """
    if text.isprintable():
        return text
    return re.sub(r"\n(?!    )", r"\\n", escaped(text))


def escaped(text: str) -> str:
    """Return a text with escapes in place of characters that control a terminal; line breaks are kept.

    Names in logs and results may hold any character. Those with an escape are all that Unicode does not call printable:
    control characters (C0, C1), bidirectional and other format characters, and halves of surrogate pairs.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return the end of a sentence, '; did you mean ...?' with the most similar known name, or an empty string."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless the number is 1."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
