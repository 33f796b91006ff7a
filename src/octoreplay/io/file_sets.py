"""Output files that belong together: all of them get their names, or none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path

from octoreplay import interrupts
from octoreplay.io.output_file import OutputFile, replacing


def write_together(files: Mapping[Path, Iterable[bytes]]) -> None:
    """Write files with the parts of their contents; they get their names when all of them are on disk.

    Raises OutputError.
    """
    with interrupts.deferred(), ExitStack() as stack:
        for path, content in files.items():
            temporary = stack.enter_context(replacing(path))
            with OutputFile(temporary) as file:
                for part in content:
                    file.write(part)
