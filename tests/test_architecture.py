"""Import contracts: they hold, and a breach of each is reported."""

import functools
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]

TWIN_CONTRACT = """
[tool.importlinter]
root_packages = ["octoreplay", "reference"]

[[tool.importlinter.contracts]]
name = "The reference twin shares no code with the package"
type = "forbidden"
source_modules = ["reference"]
forbidden_modules = ["octoreplay.mapping", "octoreplay.replay"]
ignore_imports = ["octoreplay -> octoreplay.**"]
"""
"""Contract of the reference twin. It is not in pyproject.toml because the twin is in the tests only."""

BREACHES = {
    "octoreplay.config.rules is not allowed to import octoreplay.config.run": (
        "config/rules.py",
        "from octoreplay.config import run",
    ),
    "octoreplay.io.messages is not allowed to import octoreplay.io.containers": (
        "io/messages/ros_types.py",
        "from octoreplay.io.containers import logs",
    ),
    "octoreplay.replay.exchange is not allowed to import octoreplay.replay.session": (
        "replay/exchange/messages.py",
        "from octoreplay.replay import session",
    ),
    "octoreplay.io is not allowed to import octoreplay.mapping": (
        "io/robots/poses.py",
        "from octoreplay.mapping import octree",
    ),
    "octoreplay.mapping is not allowed to import mcap": ("mapping/__init__.py", "import mcap"),
    "octoreplay.evaluate.truth -> octoreplay.mapping.kernels.storage": (
        "evaluate/truth.py",
        "from octoreplay.mapping.kernels import storage",
    ),
}
"""Text that import-linter reports: the module and the line that is added to it."""

FAR_BREACHES = {
    "octoreplay.errors is not allowed to import octoreplay.cli": ("errors.py", "from octoreplay import cli"),
    "octoreplay.mapping is not allowed to import octoreplay.io": (
        "mapping/__init__.py",
        "from octoreplay.io.robots import poses",
    ),
}
"""As BREACHES, with imports that lead on to others: those would be reported even if the contracts missed a breach."""


def check_contracts(config: Path, *folders: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the packages in ``folders``."""
    code = (
        "import sys; from importlinter.cli import lint_imports;"
        " sys.exit(lint_imports(config_filename=sys.argv[1], no_cache=True))"
    )
    # import-linter searches packages in the working folder first.
    return subprocess.run(
        [sys.executable, "-c", code, str(config)],
        cwd=folders[0], env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))},
        text=True, capture_output=True, check=False,
    )  # fmt: skip


def copied(folder: Path, to: Path) -> Path:
    shutil.copytree(folder, to, ignore=shutil.ignore_patterns("__pycache__"))
    return to


def add_line(path: Path, line: str) -> None:
    path.write_text(f"{path.read_text(encoding='utf-8')}\n{line}\n", encoding="utf-8")


def test_contracts_hold() -> None:
    done = check_contracts(ROOT / "pyproject.toml", ROOT / "src")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("breaches", [BREACHES, FAR_BREACHES], ids=["near", "far"])
def test_every_breach_is_reported(breaches: dict[str, tuple[str, str]], tmp_path: Path) -> None:
    package = copied(ROOT / "src" / "octoreplay", tmp_path / "octoreplay")
    for file, line in breaches.values():
        add_line(package / file, line)
    done = check_contracts(ROOT / "pyproject.toml", tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    assert [breach for breach in breaches if breach not in done.stdout] == []


@pytest.mark.parametrize("breach", ["", "from octoreplay.mapping import kernels", "import octoreplay.result"])
def test_reference_twin_shares_no_code_with_the_package(breach: str, tmp_path: Path) -> None:
    twin = copied(ROOT / "tests" / "reference", tmp_path / "reference")
    add_line(twin / "rules.py", breach)
    config = tmp_path / "contract.toml"
    config.write_text(TWIN_CONTRACT, encoding="utf-8")
    done = check_contracts(config, tmp_path, ROOT / "src")
    assert done.returncode == bool(breach), done.stdout + done.stderr
    assert ("reference is not allowed to import octoreplay.mapping" in done.stdout) == bool(breach)


@functools.cache
def tool(name: str) -> ModuleType:
    """A script of docs/tools."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "tools" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_shows_the_imports_of_the_source() -> None:
    rooms = tool("rooms")
    shown = rooms.PAGE.read_text(encoding="utf-8").partition(rooms.START)[2].partition(rooms.END)[0]
    assert shown == rooms.text(rooms.rooms()), "run python docs/tools/rooms.py"
    for name, drawing in rooms.drawings().items():
        assert (rooms.DRAWINGS / name).read_text(encoding="utf-8") == drawing, "run python docs/tools/rooms.py"


def test_a_new_import_changes_the_drawing() -> None:
    rooms = tool("rooms")
    imports = {"top": {"middle", "bottom"}, "middle": {"bottom"}, "bottom": set()}
    assert rooms.text(imports).splitlines()[1:4] == ["top         -> middle, bottom", "middle      -> bottom",
                                                    "bottom      -> (none)"]  # fmt: skip
    without_shortcut = {**imports, "top": {"middle"}}
    assert rooms._essential(imports) == rooms._essential(without_shortcut) == [("middle", "bottom"), ("top", "middle")]
    assert rooms._essential({**imports, "middle": set()}) == [("top", "bottom"), ("top", "middle")]


def test_circular_imports_are_named() -> None:
    rooms = tool("rooms")
    imports = {"top": {"middle"}, "middle": {"bottom", "low"}, "low": set(), "bottom": {"middle"}}
    with pytest.raises(ValueError, match=r"circular imports: (middle -> bottom -> middle|bottom -> middle -> bottom)"):
        rooms.text(imports)


def test_the_page_names_files_that_exist() -> None:
    rooms = tool("rooms")
    steps = [step.partition("\n")[2] for step in rooms.TICK]
    paths = re.findall(r"`([a-z_]+/[a-z_/.]*)`", rooms.PAGE.read_text(encoding="utf-8"))
    assert len(paths) > 30
    for path in (*steps, *paths):
        assert (rooms.PACKAGE / path).exists() or (ROOT / path).exists(), path


def test_every_room_has_its_row() -> None:
    rooms = tool("rooms")
    page = rooms.PAGE.read_text(encoding="utf-8")
    for room in rooms.rooms():
        assert f"`{room}/`" in page or f"`{room}.py`" in page, room
