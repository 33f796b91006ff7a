"""Tables and figures of the page on experiments: ``python docs/tools/experiment_tables.py`` writes them.

They are made of the stored runs: the CSV files in ``docs/experiments/NAME``, which ``octoreplay experiment NAME``
writes.
"""

from __future__ import annotations

import csv
from pathlib import Path

from octoreplay.errors import counted
from octoreplay.report.comparisons import Tables, markdown
from octoreplay.report.figures import save_figures
from octoreplay.study.experiments import Question
from octoreplay.study.questions import QUESTIONS

DOCS = Path(__file__).parents[1]
PAGE = DOCS / "experiments.md"
END = "<!-- end -->"


def main() -> None:
    """Write the tables into the page and the figures beside the runs."""
    page = PAGE.read_text(encoding="utf-8")
    for name, question in QUESTIONS.items():
        found = stored_runs(DOCS / "experiments" / name)
        if found:
            head, _, rest = page.partition(f"<!-- {name} -->\n")
            page = f"{head}<!-- {name} -->\n{page_tables(question, found)}{END}{rest.partition(END)[2]}"
            drawn = {file: drawing.draw(found) for file, drawing in question.drawings.items()}
            save_figures(drawn, DOCS / "experiments" / name)
    PAGE.write_text(page, encoding="utf-8")


def stored_runs(folder: Path) -> Tables:
    """Rows of the stored runs of an experiment by plan."""
    return {
        path.stem: list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        for path in sorted(folder.glob("*.csv"))
    }


def page_tables(question: Question, found: Tables) -> str:
    """Return the tables of an experiment as the page has them: the first open, the others folded."""
    first, *others = question.tables(found)
    if not others:
        return f"{markdown(first)}\n"
    titles = "; ".join(table.title for table in others)
    return "\n".join(
        (
            markdown(first),
            '<details markdown="1">',
            f"<summary>{counted(len(others), 'more table')}: {titles}</summary>\n",
            *map(markdown, others),
            "</details>\n\n",
        )
    )


if __name__ == "__main__":
    main()
