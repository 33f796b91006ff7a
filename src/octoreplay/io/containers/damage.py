"""Record of what could not be read of a log, and its description in one sentence."""

from __future__ import annotations

from collections.abc import Sequence

from octoreplay.config.file_url import InputFile
from octoreplay.errors import counted


class Damage:
    """Damage found in one log so far. Damage at one place counts once, however often the place is read."""

    def __init__(self) -> None:
        self._notes: dict[str, None] = {}
        self._parts: dict[tuple[str, int], int | None] = {}
        self._spans: dict[int, tuple[int, int]] = {}
        self._messages: dict[object, int] = {}

    def note(self, clause: str) -> None:
        """Record damage of the log as a whole, such as 'cut before its end'."""
        self._notes[clause] = None

    def skip_part(
        self, noun: str, offset: int, num_messages: int | None, span_ns: tuple[int, int] | None = None
    ) -> None:
        """Record a skipped part, named by ``noun``, at an offset.

        ``num_messages`` is the number of its messages, ``span_ns`` holds their least and greatest log times [ns]; None
        where they are unknown.
        """
        self._parts[noun, offset] = num_messages
        if span_ns is not None:
            self._spans[offset] = span_ns

    def skip_messages(self, where: object, num_messages: int) -> None:
        """Record messages skipped at a place; of several numbers for one place the greatest counts."""
        self._messages[where] = max(num_messages, self._messages.get(where, 0))

    @property
    def clauses(self) -> tuple[str, ...]:
        """Clauses on what is damaged and what was skipped; empty for a good log."""
        return (*self._notes, *self._skipped_parts(), *self._skipped_messages())

    def _skipped_parts(self) -> tuple[str, ...]:
        """Clause on the number of skipped parts and their messages; empty without any."""
        if not self._parts:
            return ()
        nouns = {noun for noun, _ in self._parts}
        noun = nouns.pop() if len(nouns) == 1 else "part"
        known = [count for count in self._parts.values() if count is not None]
        messages = counted(sum(known), "message")
        if not any(known):
            messages = "no message" if len(known) == len(self._parts) else "an unknown number of messages"
        elif len(known) < len(self._parts):
            messages = f"at least {messages}"
        span = ""
        if self._spans:
            span = f" ({log_times(min(self._spans.values())[0], max(end for _, end in self._spans.values()))})"
        clause = (
            f"{counted(len(self._parts), f'damaged {noun}')} with {messages}{span} {_were(len(self._parts))} skipped"
        )
        return (clause,)

    def _skipped_messages(self) -> tuple[str, ...]:
        """Clause on the number of skipped single messages; empty without any."""
        total = sum(self._messages.values())
        return (f"{counted(total, 'damaged message')} {_were(total)} skipped",) if total else ()


def damage_sentence(path: InputFile, clauses: Sequence[str], start_ns: int | None, end_ns: int | None) -> str | None:
    """Return one sentence on the damage of a log with the log times of its first and last message; None if intact."""
    if not clauses:
        return None
    span = "" if start_ns is None or end_ns is None else f" ({log_times(start_ns, end_ns)})"
    return f"{path}: {', and '.join(clauses)}; everything else is used{span}"


def log_times(start_ns: int, end_ns: int) -> str:
    """Return a span of log times [ns] in seconds."""
    return f"log times {start_ns / 1e9:.3f} s to {end_ns / 1e9:.3f} s"


def _were(number: int) -> str:
    return "was" if number == 1 else "were"
