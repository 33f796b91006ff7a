"""Dependencies: their licences, their versions, and the bill of materials."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "docs" / "tools" / "dependencies.py"


@pytest.fixture(scope="module")
def dependencies() -> ModuleType:
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("dependencies", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_licence_is_compatible(dependencies) -> None:
    licences = {name: dependencies.licence_of(name) for name in dependencies.tree()}
    assert not {name: licence for name, licence in licences.items() if not dependencies.is_compatible(licence)}


@pytest.mark.parametrize(
    ("licence", "expected"),
    [
        ("MIT", True), ("GPL-3.0-or-later", False), ("MIT OR GPL-2.0", True), ("MIT AND GPL-2.0", False),
        ("BSD-2-Clause AND Apache-2.0 WITH LLVM-exception", True), ("(MIT OR GPL-2.0) AND Zlib", True),
        ("unknown", False),
    ],
)  # fmt: skip
def test_licences_are_judged(dependencies, licence: str, expected: bool) -> None:
    assert dependencies.is_compatible(licence) == expected


def test_installed_versions_are_those_that_packages_require(dependencies) -> None:
    wrong = [
        f"{name} requires {requirement}"
        for name in dependencies.tree()
        for requirement in dependencies.requirements(name)
        if not requirement.specifier.contains(importlib.metadata.version(requirement.name), prereleases=True)
    ]
    assert wrong == []


def test_the_page_lists_every_direct_dependency(dependencies) -> None:
    page = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8")
    listed = {line.split(" | ")[0].lstrip("| ") for line in page.splitlines() if line.endswith("| octoreplay |")}
    names = {dependencies.normalised(r.name) for r in dependencies.requirements("octoreplay", dependencies.EXTRAS)}
    assert listed == names


def test_the_bill_of_materials_holds_every_package_and_its_requirements(dependencies, tmp_path: Path) -> None:
    path = tmp_path / "octoreplay.cdx.json"
    subprocess.run([sys.executable, SCRIPT, "--sbom", path], check=True)
    bill = json.loads(path.read_text())
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    assert bill["metadata"]["component"]["name"] == "octoreplay"
    names = {component["name"] for component in bill["components"]}
    assert names == dependencies.tree().keys() - {"octoreplay"}
    refs = {component["bom-ref"] for component in (bill["metadata"]["component"], *bill["components"])}
    assert len(refs) == len(names) + 1
    assert {entry["ref"] for entry in bill["dependencies"]} == refs
    assert {ref for entry in bill["dependencies"] for ref in entry["dependsOn"]} <= refs
    assert all(component["version"] and component["licenses"] for component in bill["components"])
