"""Opening of logs of every container: MCAP, ROS 1 bag, rosbag2 sqlite3 file or rosbag2 folder."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from tempfile import TemporaryDirectory

from octoreplay.config.file_url import FileUrl, InputFile, input_file
from octoreplay.errors import InputError
from octoreplay.io.containers import bag_records, mcap_records
from octoreplay.io.containers.bag_log import BagLog
from octoreplay.io.containers.db3_log import open_db3
from octoreplay.io.containers.decompression import decompress_file
from octoreplay.io.containers.folder_log import FolderLog, folder_contents
from octoreplay.io.containers.log_reader import LogReader
from octoreplay.io.containers.mcap_log import McapLog
from octoreplay.io.remote_files import local_copy
from octoreplay.records import FilePath

_MAGIC_LENGTH = 16


def open_log(path: FilePath | FileUrl) -> LogReader:
    """Open one log, of which the path or the URL is given; the reader is a context manager.

    The container is recognised by the first bytes of the file, not by its name. A file with a URL is downloaded first
    (``local_copy``). Raises InputError for a path that is missing, empty or not a log.
    """
    path = input_file(path)
    if isinstance(path, FileUrl):
        return _open_copy(local_copy(path), path)
    if path.is_dir():
        try:
            return _open_folder(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a file; give a log or the folder of a rosbag2 recording")
    try:
        with path.open("rb") as file:
            magic = file.read(_MAGIC_LENGTH)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if not magic:
        raise InputError(f"{path}: the file is empty")
    if magic.startswith(mcap_records.MAGIC):
        return McapLog(path)
    if magic.startswith(bag_records.MAGIC):
        return BagLog(path)
    if magic.startswith(b"#ROSBAG V"):
        raise InputError(f"{path}: only ROS 1 bags of version 2.0 can be read; convert an older bag with 'rosbag fix'")
    if magic.startswith(b"SQLite format 3"):
        if path.suffix != ".db3":
            raise InputError(f"{path}: a rosbag2 sqlite3 recording must end in .db3; rename it")
        return open_db3(path)
    if path.suffix in (".yaml", ".yml"):
        raise InputError(
            f"{path}: a YAML file, not a log; for a team file use 'octoreplay run {shlex.quote(str(path))}', or name"
            " its logs"
        )
    raise InputError(
        f"{path}: not a log; give MCAP (.mcap), a ROS 1 bag (.bag) or a rosbag2 recording (.db3 or folder)"
    )


def _open_folder(path: Path) -> LogReader:
    """Open the files of a rosbag2 folder as one log; raise InputError where none of them can be opened."""
    contents = folder_contents(path)
    scratch = TemporaryDirectory() if contents.has_compressed_files else None
    logs: list[LogReader] = []
    missing = []
    try:
        for file in contents.files:
            try:
                if file.is_dir():
                    raise InputError(f"{file}: a folder, but the metadata name a file")
                logs.append(open_log(file) if scratch is None else _open_compressed(file, Path(scratch.name)))
            except InputError as error:
                missing.append(str(error))
        if missing and not logs:
            raise InputError(missing[0])
    except BaseException:
        FolderLog(path, logs, scratch=scratch).close()
        raise
    clauses = [sentence.removeprefix(f"{path}{os.sep}") for sentence in missing]
    return FolderLog(path, logs, missing=clauses, compressed_messages=contents.has_compressed_messages, scratch=scratch)


def _open_compressed(file: Path, scratch: Path) -> LogReader:
    """Decompress a file into the scratch folder and open the copy."""
    copy = scratch / file.stem
    try:
        decompress_file(file, copy)
    except InputError as error:
        raise InputError(str(error).replace(str(copy), str(file))) from error
    return _open_copy(copy, file)


def _open_copy(copy: Path, file: InputFile) -> LogReader:
    """Open the copy of a log, which has the name of the original."""
    try:
        log = open_log(copy)
    except InputError as error:
        raise InputError(str(error).replace(str(copy), str(file))) from error
    log.path = file
    return log
