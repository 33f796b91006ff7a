"""Recovery of a result that was not finished: a finished file of all that its intact chunks hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.output_file import unfinished
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.io.results.unfinished import PARTIAL_SUFFIX


@dataclass(frozen=True)
class Recovery:
    """Recovered result.

    ``num_messages`` is the number of copied messages, ``extent`` a clause on the last tick and its log time, and
    ``damage`` has clauses on what could not be read. ``is_damaged`` is True where that is more than a cut end.
    """

    num_messages: int
    extent: str
    damage: tuple[str, ...]
    is_damaged: bool


def recover_result(source: Path, output: Path) -> Recovery:
    """Copy the metadata and the messages of all intact chunks of an unfinished result into a finished file.

    Its summary has ``complete`` false. Raises InputError for a file that is no result, holds no tick or is complete,
    ConfigError for an output in another folder than the files that hold the maps of a result in tiles, and OutputError
    where the output cannot be written.
    """
    with ResultReader(source, is_unfinished=True) as reader:
        if reader.is_complete and source.name.endswith(PARTIAL_SUFFIX):
            # The process ended between the last write and the renaming.
            name = source.name.removesuffix(PARTIAL_SUFFIX)
            raise InputError(f"{source}: is complete, and only its name is missing; rename it to {name}.mcap")
        if reader.is_complete:
            raise InputError(f"{source}: is complete; nothing needs to be recovered")
        if reader.last_tick() is None:
            raise InputError(f"{source}: holds no tick; run the logs again")
        if reader.tiles is not None and output.parent.resolve() != source.parent.resolve():
            # The list of these files has their paths from the folder of the result, which they may not leave.
            folder = source.parent / reader.tiles.folder
            raise ConfigError(
                f"{output}: is not beside {folder}, which holds the maps; name an output in {source.parent}"
            )
        with unfinished(output) as temporary, RosMcapWriter(temporary) as writer:
            num_messages = reader.copy_to(writer)
        return Recovery(num_messages, reader.extent, reader.damage, is_damaged=len(reader.damage) > 1)
