"""The notebooks of the documentation, run in an empty folder."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from support.long_suite import long

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
NOTEBOOKS = sorted(path.name for path in FOLDER.glob("*.ipynb"))
SECONDS = 300
"""Longest time of a cell; a notebook takes a few seconds."""


def run(name: str, folder: Path) -> nbformat.NotebookNode:
    """Run a notebook in a folder; raises for a cell with an error."""
    notebook = nbformat.read(FOLDER / name, as_version=4)
    NotebookClient(
        notebook, timeout=SECONDS, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    return notebook


def outputs(notebook: nbformat.NotebookNode, kind: str) -> list[str]:
    """Outputs of a MIME type, or of 'stream'."""
    found = []
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            if output.output_type == kind:
                found.append(output.text)
            elif kind in output.get("data", ()):
                found.append(output.data[kind])
    return found


def test_the_notebooks_are_stored_without_outputs() -> None:
    assert NOTEBOOKS == ["comparing-rules.ipynb", "my-first-map.ipynb"]
    for name in NOTEBOOKS:
        notebook = nbformat.read(FOLDER / name, as_version=4)
        nbformat.validate(notebook)
        assert [cell for cell in notebook.cells if cell.get("outputs") or cell.get("execution_count")] == []


@long
@pytest.mark.parametrize(
    ("name", "num_pictures", "num_tables"), [("comparing-rules.ipynb", 1, 3), ("my-first-map.ipynb", 2, 1)]
)
def test_a_notebook_runs(
    name: str, num_pictures: int, num_tables: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(variable, str(tmp_path / "jupyter"))
    (tmp_path / "work").mkdir()
    notebook = run(name, tmp_path / "work")
    assert len(outputs(notebook, "image/png")) == num_pictures
    assert len(outputs(notebook, "text/html")) == num_tables
    # No cell warns.
    assert [o for cell in notebook.cells for o in cell.get("outputs", ()) if o.get("name") == "stderr"] == []
    assert (tmp_path / "work" / "village" / "team.yaml").is_file()
