"""Rooms of the package and their imports, read from the source: ``python docs/tools/rooms.py`` writes both forms.

A room is a folder or a module directly in ``src/octoreplay``. The imports go into ``docs/architecture.md`` as text, and
into ``docs/architecture/rooms.svg`` as a drawing. ``tick.svg`` beside it shows the steps of a tick.
"""

from __future__ import annotations

import ast
import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "octoreplay"
PAGE = ROOT / "docs" / "architecture.md"
DRAWINGS = ROOT / "docs" / "architecture"
START, END = "<!-- rooms -->\n", "<!-- end -->"

WIDTH, ROW, BOX_WIDTH, BOX_HEIGHT = 640, 68, 112, 38

TICK = (
    "frames\nio/robots/robot_log.py",
    "integrate\nmapping/octree.py",
    "publish\nreplay/exchange",
    "deliver\nreplay/network/links.py",
    "iterate\nreplay/robots",
    "measure\nreplay/measure.py",
    "record\nreplay/recorder.py",
)
"""Steps of a tick in their order, each with its file or folder."""

SHORTCUTS = ((TICK[1], TICK[4]), (TICK[2], TICK[6]))
"""Evidence goes from the integration to the iteration; published packets go to the recorder."""


UPWARDS = {("result", "report")}
"""Imports that are made when a method is called, and that the import contracts name as exceptions."""


@functools.cache
def rooms() -> dict[str, set[str]]:
    """Return the rooms that each room imports, lowest rooms included with an empty set."""
    found: dict[str, set[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        room = _room(path.relative_to(PACKAGE).parts)
        if not room.startswith("_"):
            others = {other for other in _imported(ast.parse(path.read_text("utf-8"))) if not other.startswith("_")}
            others -= {upper for lower, upper in UPWARDS if lower == room}
            found.setdefault(room, set()).update(others - {room})
    return found


def text(imports: Mapping[str, set[str]]) -> str:
    """Return one line per room: its name and the rooms that it imports, uppermost room first.

    Raises ValueError for circular imports.
    """
    order = [room for row in _rows(imports) for room in row]
    lines = (f"{room:<12}-> {', '.join(sorted(imports[room], key=order.index)) or '(none)'}" for room in order)
    return "\n".join(["```text", *lines, "```", ""])


def drawings() -> dict[str, str]:
    """Return the drawings of the page as SVG, by file name."""
    imports = rooms()
    steps = list(itertools.pairwise(TICK))
    return {
        "rooms.svg": _svg(_rows(imports), _essential(imports)),
        "tick.svg": _svg([[step] for step in TICK], [*steps, *SHORTCUTS]),
    }


def _svg(rows: Sequence[Sequence[str]], arrows: Sequence[tuple[str, str]]) -> str:
    """Rows of boxes with arrows between them."""
    centers = {
        name: (WIDTH * (column + 1) // (len(row) + 1), ROW * level + ROW // 2)
        for level, row in enumerate(rows)
        for column, name in enumerate(row)
    }
    height = ROW * len(rows)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}">',
        "<style>text { font-family: sans-serif; text-anchor: middle }</style>",
        '<marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" orient="auto">',
        '<path d="M0 0L8 4L0 8z" fill="#555"/></marker>',
        f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>',
        *(_arrow(centers[start], centers[end]) for start, end in arrows),
        *(_box(name, *center) for name, center in centers.items()),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _room(parts: Sequence[str]) -> str:
    """Name of the room of a file or module, from its path inside the package."""
    return parts[0].removesuffix(".py")


def _imported(tree: ast.Module) -> Iterator[str]:
    """Names of the rooms that a module imports, at its top or inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "octoreplay":
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("octoreplay."):
            yield _room((node.module or "").split(".")[1:])
        elif isinstance(node, ast.Import):
            yield from (
                _room(alias.name.split(".")[1:]) for alias in node.names if alias.name.startswith("octoreplay.")
            )


def _rows(imports: Mapping[str, set[str]]) -> list[list[str]]:
    """Rooms from top to bottom; every import leads to a lower row."""
    levels: dict[str, int] = {}

    def level(room: str, *above: str) -> int:
        if room in above:
            raise ValueError(f"circular imports: {' -> '.join((*above[above.index(room) :], room))}")
        if room not in levels:
            levels[room] = 1 + max((level(other, *above, room) for other in imports[room]), default=-1)
        return levels[room]

    highest = max(level(room) for room in imports)
    return [sorted(room for room in imports if levels[room] == highest - row) for row in range(highest + 1)]


def _essential(imports: Mapping[str, set[str]]) -> list[tuple[str, str]]:
    """Imports that do not follow from a chain of other imports."""

    def below(room: str) -> set[str]:
        return imports[room].union(*(below(other) for other in imports[room]))

    return sorted(
        (room, other)
        for room, others in imports.items()
        for other in others
        if not any(other in below(between) for between in others)
    )


def _arrow(start: tuple[int, int], end: tuple[int, int]) -> str:
    """A straight arrow to the next row, or one that bends around the boxes of the rows that it passes."""
    half = BOX_HEIGHT // 2
    if end[1] - start[1] <= ROW:
        path = f"M{start[0]} {start[1] + half}L{end[0]} {end[1] - half}"
    else:
        right, near_end = start[0] + BOX_WIDTH // 2, end[0] + BOX_WIDTH // 2
        path = f"M{right} {start[1]}C{right + ROW} {start[1]} {near_end + ROW} {end[1]} {near_end} {end[1]}"
    return f'<path d="{path}" fill="none" stroke="#555" marker-end="url(#tip)"/>'


def _box(name: str, x: int, y: int) -> str:
    """A box with a name, and with the file of a step below it."""
    title, _, file = name.partition("\n")
    lines = [f'<text x="{x}" y="{y - 3 if file else y + 5}" font-size="14">{escape(title)}</text>']
    if file:
        lines.append(f'<text x="{x}" y="{y + 13}" font-size="11">{escape(file)}</text>')
    return (
        f'<rect x="{x - BOX_WIDTH // 2}" y="{y - BOX_HEIGHT // 2}" width="{BOX_WIDTH}" height="{BOX_HEIGHT}" rx="5"'
        f' fill="#d9f2ee" stroke="#00796b"/>{"".join(lines)}'
    )


def main() -> None:
    """Write the drawings, and the text into the page; exit with a sentence on circular imports."""
    try:
        list_of_rooms = text(rooms())
    except ValueError as error:
        raise SystemExit(str(error)) from error
    for name, drawing in drawings().items():
        (DRAWINGS / name).write_text(drawing, encoding="utf-8")
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(START)
    PAGE.write_text(before + START + list_of_rooms + END + rest.partition(END)[2], encoding="utf-8")


if __name__ == "__main__":
    main()
