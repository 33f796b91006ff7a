"""Tables of the terminal as HTML."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text


def html_of(part: RenderableType) -> str:
    """Return tables, texts and groups of them as HTML elements. Raises TypeError for anything else."""
    if isinstance(part, Group):
        return "".join(map(html_of, part.renderables))
    if isinstance(part, Padding):
        return html_of(part.renderable)
    if isinstance(part, Table):
        return _table(part)
    text = _plain(part)
    return f"<p>{_escaped(text)}</p>" if text.strip() else ""


def html_table(title: str, header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table with a title, a header (omitted if all its cells are empty), and rows of text cells."""
    head = "".join(f'<th scope="col">{_escaped(cell)}</th>' for cell in header)
    body = "".join(f"<tr>{''.join(f'<td>{_escaped(cell)}</td>' for cell in row)}</tr>" for row in rows)
    top = f"<thead><tr>{head}</tr></thead>" if head.replace('<th scope="col"></th>', "") else ""
    caption = f"<caption>{_escaped(title)}</caption>" if title else ""
    return f'<div class="table"><table>{caption}{top}<tbody>{body}</tbody></table></div>'


def _table(table: Table) -> str:
    """A table of the terminal."""
    columns = [[_plain(cell) for cell in column.cells] for column in table.columns]
    header = [_plain(column.header).replace("-\n", "").replace("\n", " ") for column in table.columns]
    title = "" if table.title is None else _plain(table.title)
    return html_table(title, header if table.show_header else [], zip(*columns, strict=True))


def _plain(part: object) -> str:
    """Text of a cell."""
    if isinstance(part, Text):
        return part.plain
    if isinstance(part, str):
        return part
    raise TypeError(f"{type(part).__name__} cannot be shown as HTML")


def _escaped(text: str) -> str:
    """Text as HTML with its line breaks."""
    return escape(text).replace("\n", "<br>")
