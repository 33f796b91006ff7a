"""Hooks of ``mkdocs build``: pages from outside docs/, links to files that the site does not have, and the options.

Pages are written for reading in the repository, with relative links. The site adds the pages of ``OUTSIDE`` and turns
links to other files of the repository, such as scripts, into plain text.
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Iterator
from pathlib import Path

import click
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from octoreplay.cli import cli
from octoreplay.commands.options import option_groups

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"

OUTSIDE = {
    "benchmarks/README.md": "benchmarks.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
}
"""Pages outside docs/ that the site has too, and their names in the site."""

HOME = {"README.md": "index.md"}
"""Pages that another page of the site replaces."""

OPTIONS_MARK = "<!-- options -->"
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\((?![a-z]+:|#)([^)#\s]*)(#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from outside docs/."""
    for source, name in OUTSIDE.items():
        files.append(File.generated(config, name, abs_src_path=str(ROOT / source)))
    return files


def on_page_markdown(markdown: str, page: Page, files: Files, **_: object) -> str:
    """Return the page with its links as the site needs them, and with the options where they belong."""
    names = {name: ROOT / source for source, name in OUTSIDE.items()}
    folder = names.get(page.file.src_uri, DOCS / page.file.src_uri).parent
    site_folder = Path(page.file.src_uri).parent

    def relinked(match: re.Match[str]) -> str:
        image, text, target, anchor = match.groups()
        path = Path(os.path.normpath(folder / target))
        if not path.exists():
            return match[0]
        name = path.relative_to(ROOT).as_posix()
        uri = (OUTSIDE | HOME).get(name) or (path.relative_to(DOCS).as_posix() if path.is_relative_to(DOCS) else "")
        if files.get_file_from_path(uri) is None:
            return text
        return f"{image}[{text}]({os.path.relpath(uri, site_folder)}{anchor or ''})"

    return LINK.sub(relinked, markdown).replace(OPTIONS_MARK, "\n".join(_commands(cli, "octoreplay")))


def _commands(group: click.Group, path: str) -> Iterator[str]:
    """Markdown lines that describe the commands of a group."""
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from _commands(command, f"{path} {name}")
        else:
            yield from _command(command, f"{path} {name}")


def _command(command: click.Command, path: str) -> Iterator[str]:
    """Markdown lines that describe one command: usage, text, and a table of options for each section."""
    context = click.Context(command, info_name=path)
    usage = " ".join([path, *command.collect_usage_pieces(context)])
    yield from (f"## {path}", "", "```text", usage, "```", "", _escaped(inspect.cleandoc(command.help or "")), "")
    for section, records in option_groups(command, context).items():
        yield from (f"**{section}**", "", "| option | meaning |", "|---|---|")
        yield from (f"| `{option}` | {_escaped(text)} |" for option, text in records)
        yield ""


def _escaped(text: str) -> str:
    """Text without markup: brackets, stars, underscores, pipes and angle brackets are escaped."""
    return re.sub(r"([\[\]*_|<>])", r"\\\1", text)
