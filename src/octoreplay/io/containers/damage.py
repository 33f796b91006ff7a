"""What could not be read of a log: counted as it is come upon, and said in one sentence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


class Damage:
    """The damage of one log, as far as it has been read; nothing is counted twice, however often it is read."""

    def __init__(self) -> None:
        self._notes: dict[str, None] = {}
        self._parts: dict[tuple[str, int], int | None] = {}
        self._messages: dict[object, int] = {}

    def note(self, clause: str) -> None:
        """Remember something about the whole log, such as 'cut before its end'."""
        self._notes[clause] = None

    def skip(self, noun: str, offset: int, num_messages: int | None) -> None:
        """Count a part that was left out: what it is, where it is, and its messages (None: nobody knows)."""
        self._parts[noun, offset] = num_messages

    def lose(self, where: object, num_messages: int) -> None:
        """Count single messages that were left out somewhere; the most that was said of a place stands."""
        self._messages[where] = max(num_messages, self._messages.get(where, 0))

    @property
    def clauses(self) -> tuple[str, ...]:
        """What is wrong and what was skipped, for a sentence; empty for a good log."""
        return (*self._notes, *self._skipped_parts(), *self._skipped_messages())

    def _skipped_parts(self) -> tuple[str, ...]:
        """How many parts were left out, with how many messages."""
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
        return (f"{counted(len(self._parts), f'damaged {noun}')} with {messages} {_were(len(self._parts))} skipped",)

    def _skipped_messages(self) -> tuple[str, ...]:
        """How many single messages were left out."""
        total = sum(self._messages.values())
        return (f"{counted(total, 'damaged message')} {_were(total)} skipped",) if total else ()


def damage_sentence(path: Path, clauses: Sequence[str]) -> str | None:
    """A log and what is wrong with it in one sentence; None where nothing is."""
    return f"{path}: {', and '.join(clauses)}; everything else is used" if clauses else None


def counted(number: int, noun: str) -> str:
    """A number and its noun, in the plural where it is not one."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _were(number: int) -> str:
    return "was" if number == 1 else "were"
