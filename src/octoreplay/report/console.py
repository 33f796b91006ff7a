"""Console that shows names from logs and results without letting them control the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from octoreplay.errors import escaped, printable


class EscapingConsole(Console):
    """Console that shows characters that would control the terminal as escapes."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print sentences and tables; line breaks in a sentence are escaped too."""
        super().print(*(printable(item) if isinstance(item, str) else item for item in objects), **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the text of a cell."""
        return super().render_str(escaped(text), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Yield the parts of a table or text; those that the console adds itself are control codes."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(escaped(segment.text), segment.style)
