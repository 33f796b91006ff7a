"""Dependencies of the installed package: ``python docs/tools/dependencies.py`` writes their licences to a page.

With ``--sbom FILE.json`` the script writes a software bill of materials (CycloneDX 1.6) of this environment instead.
"""

from __future__ import annotations

import argparse
import importlib.metadata as metadata
import json
import re
import tomllib
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "dependencies.md"
START, END = "<!-- dependencies -->\n", "<!-- end -->"
NAME = "octoreplay"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = tuple(sorted(PROJECT["optional-dependencies"].keys() - {"test", "bench", "docs"}))
"""Extras for users."""

COMPATIBLE = frozenset({
    "0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "CC0-1.0", "HPND", "ISC", "MIT", "MIT-0", "MIT-CMU",
    "MPL-2.0", "PSF-2.0", "Unlicense", "Zlib", "any-OSI",
})  # fmt: skip
"""Licences (SPDX) of libraries that a program under Apache-2.0 may use and be distributed with."""

_IDS = {
    "apache 2": "Apache-2.0", "apache 2.0": "Apache-2.0", "apache software license": "Apache-2.0",
    "bsd": "BSD-3-Clause", "bsd license": "BSD-3-Clause", "bsd 3-clause license": "BSD-3-Clause",
    "3-clause bsd license": "BSD-3-Clause", "isc license (iscl)": "ISC", "mit license": "MIT",
    "historical permission notice and disclaimer (hpnd)": "HPND",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0", "python software foundation license": "PSF-2.0",
    "gnu general public license v3 or later (gplv3+)": "GPL-3.0-or-later",
}  # fmt: skip
"""SPDX identifiers of licences as packages name them, in lower case."""


def normalised(name: str) -> str:
    """Return a package's name in the form of package indexes."""
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements(name: str, extras: tuple[str, ...] = ()) -> list[Requirement]:
    """Return what octoreplay, or an installed package, requires in this environment."""
    if name == NAME:
        texts = [*PROJECT["dependencies"], *(text for e in extras for text in PROJECT["optional-dependencies"][e])]
    else:
        texts = metadata.requires(name) or []
    found = [Requirement(text) for text in texts]
    return [r for r in found if r.marker is None or any(r.marker.evaluate({"extra": e}) for e in (*extras, ""))]


def tree() -> dict[str, list[str]]:
    """Return the packages that octoreplay uses, itself first, each with the packages that it requires."""
    found: dict[str, list[str]] = {}
    waiting = [(NAME, EXTRAS)]
    while waiting:
        name, extras = waiting.pop(0)
        if name not in found:
            needed = requirements(name, extras)
            found[name] = sorted({normalised(r.name) for r in needed})
            waiting += [(normalised(r.name), tuple(sorted(r.extras))) for r in needed]
    return found


def licence_of(name: str) -> str:
    """Return the licence of an installed package as an SPDX expression, or in the package's own words."""
    found = metadata.metadata(name)
    if found["License-Expression"]:
        return str(found["License-Expression"])
    classifiers = [c.rpartition(" :: ")[2] for c in found.get_all("Classifier") or () if c.startswith("License ::")]
    text = (found["License"] or "").partition("\n")[0].strip()
    # apsw is under any licence of the Open Source Initiative, by choice of its user.
    for words in (*classifiers, text):
        if words.lower() in _IDS or words in COMPATIBLE:
            return _IDS.get(words.lower(), words)
    return text or ", ".join(classifiers) or "unknown"


def is_compatible(licence: str) -> bool:
    """Return True where a licence, or one side of each OR in it, is compatible with Apache-2.0."""
    parts = re.split(r"\s+AND\s+", licence.replace("(", "").replace(")", ""))
    choices = [re.split(r"\s+OR\s+", part) for part in parts]
    return all(any(choice.partition(" WITH ")[0] in COMPATIBLE for choice in options) for options in choices)


def table() -> str:
    """Return the table of licences: direct dependencies first."""
    needed = tree()
    direct = needed.pop(NAME)
    lines = ["| package | licence | required by |", "|---|---|---|"]
    for name in (*direct, *sorted(needed.keys() - set(direct))):
        users = [user for user, of_user in needed.items() if name in of_user]
        lines.append(
            f"| {name} | {licence_of(name)} | {'octoreplay' if name in direct else ', '.join(sorted(users))} |"
        )
    return "\n".join(lines) + "\n"


def bill_of_materials() -> dict[str, Any]:
    """Return the packages that octoreplay uses, with versions and licences, in the form of CycloneDX 1.6."""
    needed = tree()
    refs = {name: f"pkg:pypi/{name}@{metadata.version(name)}" for name in needed}
    components = list(_components(refs))
    content = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": components[0]},
        "components": components[1:],
        "dependencies": [{"ref": refs[name], "dependsOn": [refs[n] for n in of]} for name, of in needed.items()],
    }
    # The same packages give the same number.
    number = uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(content, sort_keys=True))
    return {**content, "serialNumber": f"urn:uuid:{number}"}


def _components(refs: dict[str, str]) -> Iterator[dict[str, Any]]:
    """Packages as CycloneDX components."""
    for name, ref in refs.items():
        yield {
            "type": "application" if name == NAME else "library",
            "bom-ref": ref,
            "name": name,
            "version": metadata.version(name),
            "purl": ref,
            "licenses": [{"license": {"name": licence_of(name)}}],
        }


def main() -> None:
    """Write the page, or a bill of materials."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sbom", type=Path, metavar="FILE.json", help="write a software bill of materials")
    sbom = parser.parse_args().sbom
    if sbom is not None:
        sbom.write_text(json.dumps(bill_of_materials(), indent=2) + "\n", encoding="utf-8")
        return
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(START)
    PAGE.write_text(before + START + table() + END + rest.partition(END)[2], encoding="utf-8")


if __name__ == "__main__":
    main()
