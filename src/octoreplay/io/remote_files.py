"""Local copies of input files that are named by URL, in a cache folder.

An object is downloaded once, as a whole. Its copy is used until the store names another version of it: the name of the
copy's folder is made of the URL and of what the store gives as identity (generation, ETag or time of the last change,
and size). fsspec and the packages of the stores are optional: ``pip install 'octoreplay[remote]'``.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import logging
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from octoreplay.config.file_url import FileUrl, InputFile, without_credentials
from octoreplay.errors import ConfigError, InputError, OctoreplayError, OutputError
from octoreplay.io.output_file import InUseError, unfinished

_log = logging.getLogger(__name__)

Progress: TypeAlias = Callable[[int, int | None], None]
"""Callback with the numbers of bytes that are there, and of all where it is known."""

_VERSION_FIELDS = ("generation", "ETag", "etag", "LastModified", "Last-Modified", "updated")
"""Fields of a store's description that change with the object; the first one that is given counts."""
_POLL_SECONDS = 0.5
_CONNECT_SECONDS = 30.0
_READ_SECONDS = 60.0
"""Longest time without a byte [s]. A download as a whole may take any time."""
_PART_BYTES = 8 << 20
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_WITHOUT_CREDENTIALS = ("NoCredentialsError", "PartialCredentialsError", "ProfileNotFound", "DefaultCredentialsError")
_LOGGERS = ("asyncio", "aiobotocore", "botocore", "fsspec", "gcsfs", "google", "s3fs")
_REFUSED, _MISSING = (401, 403), (404, 410)

_mutex = threading.Lock()
_copies: dict[FileUrl, Path] = {}
"""Copies that this process uses: each object has one version during a process."""


def _hidden(_: FileUrl) -> AbstractContextManager[Progress]:
    """Progress that nobody sees."""
    return contextlib.nullcontext(lambda *_: None)


_shown: list[Callable[[FileUrl], AbstractContextManager[Progress]]] = [_hidden]


def show_downloads(show: Callable[[FileUrl], AbstractContextManager[Progress]]) -> None:
    """Show all later downloads of this process: ``show`` gives a context manager with the callback of one download."""
    _shown[0] = show


def local_copy(file: InputFile) -> Path:
    """Return the path of an input file, of one with a URL the path of its copy, which is downloaded where needed.

    A process asks the store once for each URL, and then uses the same version of the object. Raises ConfigError without
    the packages for the URL, InputError where the object cannot be read, OutputError where the copy cannot be written.
    """
    if isinstance(file, Path):
        return file
    with _mutex:
        if file not in _copies:
            _copies[file] = _current_copy(file)
        return _copies[file]


def cache_folder() -> Path:
    """Return the folder of the copies. Raises ConfigError where this user has no home folder."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "octoreplay" / "logs"
    except RuntimeError as error:
        raise ConfigError("XDG_CACHE_HOME: name the folder for copies of files; there is no home folder") from error


@dataclass(frozen=True)
class _Version:
    """Version of an object: size [byte] and identity as the store gives them, None where it does not."""

    size: int | None
    identity: str | None


def _current_copy(file: FileUrl) -> Path:
    """Copy of the present version of an object."""
    with _quiet(), _store_errors(file):
        system = _file_system(file)
        version = _version(file, system)
    key = hashlib.sha256(f"{file.url}\n{version.identity}\n{version.size}".encode()).hexdigest()[:32]
    copy = cache_folder() / key / file.name
    is_new, is_waiting = version.identity is None, False
    while is_new or not _is_whole(copy, version.size):
        try:
            _download(file, system, version, copy)
            is_new = False
        except InUseError:
            if not is_waiting:
                _log.info("waiting for another process, which downloads %s", file)
            is_waiting = True
            time.sleep(_POLL_SECONDS)
    return copy


def _is_whole(copy: Path, size: int | None) -> bool:
    """True for a copy that exists, with the size of the object."""
    return copy.is_file() and size in (None, copy.stat().st_size)


def _download(file: FileUrl, system: Any, version: _Version, copy: Path) -> None:
    """Download one version of an object; the copy gets its name when it is complete."""
    _make_room(file, version, copy.parent)
    from fsspec.callbacks import Callback

    with unfinished(copy) as temporary, _shown[0](file) as progress:
        _log.info("downloading %s%s", file, "" if version.size is None else f" ({version.size:,} bytes)")
        callback = Callback(hooks={"progress": lambda size, value, **_: progress(value, version.size or size)})
        with _quiet(), _store_errors(file, callback):
            system.get_file(_object_name(file, system), str(temporary), callback=callback)
            now = _version(file, system)
        found = temporary.stat().st_size
        if now != version:
            raise InputError(f"{file}: has changed while it was downloaded; run the command again")
        if version.size not in (None, found):
            raise InputError(
                f"{file}: the download ended after {found:,} of {version.size:,} bytes; run the command again"
            )


def _make_room(file: FileUrl, version: _Version, folder: Path) -> None:
    """Make the folder of a copy. Raises OutputError where it cannot be written, or has too little space."""
    try:
        # Other users cannot read the copies.
        for parent in (folder.parent, folder):
            parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise OutputError(
            f"{folder.parent}: copies of files cannot be written: {error.strerror}; name another folder in"
            " XDG_CACHE_HOME"
        ) from error
    if version.size is not None and free < version.size:
        raise OutputError(
            f"{file}: takes {version.size:,} bytes, but {folder.parent} has {free:,} left; remove copies there, or name"
            " another folder in XDG_CACHE_HOME"
        )


def _file_system(file: FileUrl) -> Any:
    """File system of fsspec for a URL. Raises ConfigError where a package is missing."""
    scheme = file.url.partition("://")[0]
    try:
        import fsspec

        return fsspec.filesystem(scheme, **_options(scheme))
    except ImportError as error:
        raise ConfigError(
            f"{file}: {scheme}:// needs packages that are not installed; use pip install 'octoreplay[remote]'"
        ) from error


def _options(scheme: str) -> Mapping[str, Any]:
    """Options of a file system: small parts, proxies and .netrc of the user, and a download may take any time."""
    if scheme == "s3":
        # s3fs holds ten parts in memory, of 50 MiB by default.
        return {"default_block_size": _PART_BYTES}
    import aiohttp

    limits = aiohttp.ClientTimeout(total=None, sock_connect=_CONNECT_SECONDS, sock_read=_READ_SECONDS)
    name = "session_kwargs" if scheme == "gs" else "client_kwargs"
    return {name: {"trust_env": True, "timeout": limits}}


def _object_name(file: FileUrl, system: Any) -> str:
    """Name of an object in its store."""
    # Public functions of fsspec would take the URL for a pattern or a chain of stores.
    name: str = system._strip_protocol(file.url)  # noqa: SLF001 - fsspec's own way to name an object
    return name


def _version(file: FileUrl, system: Any) -> _Version:
    """Present version of an object. Raises InputError for a folder."""
    system.invalidate_cache()
    info = system.info(_object_name(file, system))
    if info.get("type") == "directory":
        raise InputError(
            f"{file}: is a folder; give the URL of one file (.mcap, .bag, .db3), or mount the store to read a rosbag2"
            " folder"
        )
    found = next((f"{name}={info[name]}" for name in _VERSION_FIELDS if info.get(name)), None)
    return _Version(None if info.get("size") is None else int(info["size"]), found)


@contextlib.contextmanager
def _store_errors(file: FileUrl, callback: Any = None) -> Iterator[None]:
    """Turn the errors of a store into InputError, and those of the disk into OutputError."""
    try:
        yield
    except OctoreplayError:
        raise
    # The packages of the stores raise their own errors of many kinds.
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _DISK_ERRORS:
            raise OutputError(
                f"{cache_folder()}: cannot be written: {error.strerror}; remove copies there, or name another folder in"
                " XDG_CACHE_HOME"
            ) from error
        if callback is not None and callback.value:
            raise InputError(
                f"{file}: the download ended after {callback.value:,} bytes: {_cause(error)}; run the command again"
            ) from error
        # fsspec takes every error of a web server for a missing file.
        is_wrapped = file.is_web and isinstance(error, FileNotFoundError) and isinstance(error.__cause__, Exception)
        raise InputError(f"{file}: {_cause(error.__cause__ if is_wrapped else error)}") from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the logs of the packages of the stores, which print each error before they raise it."""
    levels = {logger: logger.level for logger in map(logging.getLogger, _LOGGERS)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def _cause(error: BaseException | None) -> str:
    """Clause on an error of a store."""
    name = type(error).__name__
    # aiohttp and gcsfs name the number differently.
    status = getattr(error, "status", None) or getattr(error, "code", None)
    if isinstance(error, FileNotFoundError) or status in _MISSING:
        return "no such object; check the bucket or host, and the name"
    if name in _WITHOUT_CREDENTIALS:
        return (
            "no credentials were found; give them in the environment or in the files of the store's own tools (for a"
            " public bucket on S3 set FSSPEC_S3_ANON=true)"
        )
    if isinstance(error, PermissionError) or status in _REFUSED or str(error).startswith("Forbidden"):
        return "access was refused; check the credentials"
    if isinstance(status, int):
        return f"the server answered {status}"
    text = " ".join(without_credentials(str(error)).split())
    return f"cannot be read: {text or name}"
