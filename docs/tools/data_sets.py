"""Write the tables of docs/datasets.md from the descriptions of the data sets in the source."""

from __future__ import annotations

import re
from pathlib import Path

from octoreplay.io.datasets.catalogue.registry import DATA_SETS

PAGE = Path(__file__).parent.parent / "datasets.md"


def tables() -> dict[str, str]:
    """Return each table, by the name in its marker."""
    checked = ["| name | compared with | sources |", "|---|---|---|"]
    checked += [
        f"| `{name}` | {data_set.checked} | {', '.join(f'<{source}>' for source in data_set.sources)} |"
        for name, data_set in DATA_SETS.items()
    ]
    notes = ["| data set | notes |", "|---|---|"]
    notes += [
        f"| `{name}`: {data_set.title} | {' '.join((f'Holds {data_set.holds}.', *data_set.notes))} |"
        for name, data_set in DATA_SETS.items()
    ]
    return {"data sets": "\n".join(checked), "notes": "\n".join(notes)}


def page(text: str) -> str:
    """Return the text of the page with its tables."""
    for marker, rows in tables().items():
        pattern = re.compile(rf"<!-- {marker} -->\n.*?<!-- end -->", re.DOTALL)
        text = pattern.sub(lambda _, marker=marker, rows=rows: f"<!-- {marker} -->\n{rows}\n<!-- end -->", text)
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
