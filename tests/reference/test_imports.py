from __future__ import annotations

import ast
from pathlib import Path

import pytest

ALLOWED = {"octoreplay.errors", "octoreplay.records", "octoreplay.run_metrics"}
MODULES = sorted(path for path in Path(__file__).parent.glob("*.py") if not path.name.startswith("test_"))


def _imports(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide where they lead"
            yield node.module
            if node.module == "octoreplay":
                yield from (f"octoreplay.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.name)
def test_reference_imports_no_code_under_test(path):
    imported = list(_imports(path))
    assert imported
    ours = {name for name in imported if name.split(".")[0] == "octoreplay"}
    assert all(name in ALLOWED or name.startswith("octoreplay.config.") for name in ours)
    others = {name.split(".")[0] for name in imported} - {"octoreplay", "reference", "numpy"}
    assert others <= {"__future__", "collections", "dataclasses", "itertools", "math", "pathlib", "random", "typing"}
