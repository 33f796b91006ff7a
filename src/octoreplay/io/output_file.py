"""Output files: a lock against other writers, and files and folders that get their name when they are complete.

All outputs are written under a temporary name in the target's folder, flushed to disk, and renamed. A symbolic link
under the target's name is replaced by the new file; what it refers to is not changed.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import functools
import hashlib
import logging
import os
import re
import shlex
import shutil
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

from octoreplay import interrupts
from octoreplay.config.file_url import without_credentials
from octoreplay.errors import EARLY, OutputError

SYNC_SECONDS = 5.0
"""Least time between two flushes to disk of a file that is written over a long time."""
FOLDER_LOCK = ".lock"
"""Lock file of an output folder, inside it."""

_LONGEST_NAME = 180
"""Longest part of the target's name in names of temporary and lock files [bytes]; file systems allow 255 in all."""
_UNSUPPORTED = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)
_log = logging.getLogger(__name__)
_temporary_paths: dict[Path, int] = {}
"""Temporary files and folders, with the process that made them: a forked process does not remove them."""


class InUseError(OutputError):
    """Another process, or another writer in this one, writes the output."""


class OutputFile:
    """New file, written without buffering; a context manager that closes it.

    The file is created; an existing file or link under its name is an error. A failed write leaves the bytes of the
    writes before it. Written data are flushed to disk at most every SYNC_SECONDS. Raises OSError.
    """

    def __init__(self, path: Path) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
        self._descriptor = os.open(path, flags, 0o666)
        self._identity = os.fstat(self._descriptor)
        self._size = 0
        self._synced = time.monotonic()
        self.is_damaged = False
        """True after a failed write; set by a writer that must not go on for another reason."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def write(self, data: bytes) -> int:
        """Write all bytes, or none of them, and return their number."""
        try:
            rest = memoryview(data).cast("B")
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            self.is_damaged = True
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self._size)
                os.lseek(self._descriptor, self._size, os.SEEK_SET)
            raise
        self._size += len(data)
        if time.monotonic() > self._synced + SYNC_SECONDS:
            self.sync()
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._size

    def flush(self) -> None:
        """Do nothing: no byte is buffered."""

    def sync(self) -> None:
        """Flush the written data to disk."""
        os.fsync(self._descriptor)
        self._synced = time.monotonic()

    def is_at(self, path: Path) -> bool:
        """Return True if a path is this file, and not one that another process has put there."""
        with contextlib.suppress(OSError):
            return os.path.samestat(self._identity, path.lstat())
        return False

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


class _Lock:
    """Lock of an output that this process holds; ``is_exclusive`` is False where the file system has no locks."""

    def __init__(self, path: Path, descriptor: int, is_exclusive: bool) -> None:
        self.path = path
        self.descriptor = descriptor
        self.is_exclusive = is_exclusive
        self.count = 0
        self.has_writer = False
        self.is_awaited = False
        self.is_written = False


_locks: dict[str, _Lock] = {}
_mutex = threading.Lock()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an OSError of the body into an OutputError for ``path``."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


@contextmanager
def locked(path: Path, *, is_folder: bool = False, is_awaited: bool = False) -> Iterator[None]:
    """Hold the lock of an output file, or of an output folder, which is created if missing.

    A command holds the lock from its beginning with ``is_awaited``; the output then counts for ``mark_written``. Within
    the same process one writer at a time can hold it too. The lock ends with its process, also after a kill. Where the
    file system has no locks, a warning says so once. Raises OutputError, which names the other process, where the
    output is in use (InUseError), and where the lock file cannot be written.
    """
    made = _make_folders(path) if is_folder else []
    lock: _Lock | None = None
    try:
        lock = _acquire(path, path / FOLDER_LOCK if is_folder else _hidden(path, "lock"), is_writer=not is_awaited)
        lock.is_awaited = lock.is_awaited or is_awaited
        yield
    finally:
        if lock is not None:
            _release(lock, is_writer=not is_awaited)
        for folder in reversed(made):
            with contextlib.suppress(OSError):
                folder.rmdir()


def mark_written(path: Path) -> None:
    """Note that an output is complete. After the last awaited output signals are ignored (``interrupts.finish``)."""
    places = (_place(_hidden(path, "lock")), _place(path / FOLDER_LOCK))
    with _mutex:
        for place in places:
            if place in _locks:
                _locks[place].is_written = True
        awaited = [lock for lock in _locks.values() if lock.is_awaited]
    if awaited and all(lock.is_written for lock in awaited):
        interrupts.finish()


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file (text in UTF-8), which gets its name when it is complete. Raises OutputError."""
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    with interrupts.deferred(), replacing(path) as temporary, OutputFile(temporary) as file:
        file.write(data)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path for a new file, which is renamed to ``path`` at the end, and removed after any error.

    An OSError becomes an OutputError.
    """
    with locked(path):
        temporary = temporary_path(path)
        try:
            with writing(path):
                yield temporary
                publish(temporary, path)
        finally:
            remove_temporary(temporary)


@contextmanager
def unfinished(path: Path) -> Iterator[Path]:
    """Yield a path as ``replacing`` does; an interrupt removes the file, also where a library has caught it."""
    with replacing(path) as temporary:
        yield temporary
        interrupts.check()


def publish(temporary: Path, path: Path) -> None:
    """Flush a complete file or folder to disk and give it its name. Raises OSError, and then leaves it as it is."""
    with interrupts.deferred():
        _sync_tree(temporary)
        temporary.replace(path)
        mark_written(path)
        sync_folder(path.parent)


class NewFolder:
    """Folder in preparation: files are written into ``path``, and ``put`` gives it its name."""

    def __init__(self, folder: Path) -> None:
        self.path = temporary_path(folder)
        self._folder = folder
        self._former = temporary_path(folder)
        self._is_put = False

    def put(self) -> None:
        """Replace the folder by the new one, or remove it where the new one is empty. Raises OSError."""
        with interrupts.deferred():
            if self._folder.exists():
                self._folder.replace(self._former)
            if any(self.path.iterdir()):
                publish(self.path, self._folder)
            self._is_put = True

    def take_back(self) -> None:
        """Restore the former folder."""
        with interrupts.deferred(), contextlib.suppress(OSError):
            if self._is_put and self._folder.exists():
                self._folder.replace(self.path)
            if self._former.exists():
                self._former.replace(self._folder)

    def clean(self) -> None:
        """Remove what is left under temporary names."""
        remove_temporary(self.path)
        remove_temporary(self._former)


@contextmanager
def new_folder(folder: Path) -> Iterator[NewFolder]:
    """Yield a folder in preparation. After an error in the body the former folder is restored.

    An OSError becomes an OutputError.
    """
    with locked(folder):
        new = NewFolder(folder)
        try:
            with writing(folder):
                new.path.mkdir()
                yield new
        except BaseException:
            new.take_back()
            raise
        finally:
            new.clean()


def temporary_path(path: Path) -> Path:
    """Return a new hidden path beside a target. What is left there at the end of the process is removed."""
    temporary = _hidden(path, f"{os.urandom(4).hex()}.tmp")
    _temporary_paths[temporary] = os.getpid()
    return temporary


def remove_temporary(path: Path) -> None:
    """Remove a temporary file or folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
    _temporary_paths.pop(path, None)


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to disk, on file systems that can do so. Raises OSError."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:
        # A folder may allow new files and no reading.
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def sync_files(folder: Path) -> None:
    """Flush all files below a folder, and the folder, to disk. Raises OSError."""
    for path in folder.iterdir():
        _sync_tree(path)
    sync_folder(folder)


def _sync_tree(path: Path) -> None:
    """Flush a file, or a folder with its files, to disk."""
    if path.is_dir():
        sync_files(path)
        return
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _hidden(path: Path, suffix: str) -> Path:
    """Return the path of a hidden file beside a target."""
    name = path.name or path.resolve().name
    if len(os.fsencode(name)) > _LONGEST_NAME:
        name = hashlib.sha256(os.fsencode(name)).hexdigest()
    return path.parent / f".{name}.{suffix}"


def _make_folders(path: Path) -> list[Path]:
    """Create a folder with its parents, and return those that were missing, the highest first."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()][::-1]
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)
    return missing


def _place(lock_path: Path) -> str:
    """Return the key of a lock file, equal for all spellings of its path."""
    return str(lock_path.parent.resolve() / lock_path.name)


def _acquire(target: Path, lock_path: Path, *, is_writer: bool) -> _Lock:
    """Take the lock of an output, or take it once more. Raises InUseError where it is in use."""
    place = _place(lock_path)
    with _mutex:
        lock = _locks.get(place)
        if lock is None:
            lock = _locks[place] = _Lock(lock_path, *_open_lock(target, lock_path))
            if lock.is_exclusive and lock_path.parent == target.parent:
                _remove_leftovers(target)
        if is_writer and lock.has_writer:
            raise InUseError(_in_use(target, _own_name()))
        lock.has_writer = lock.has_writer or is_writer
        lock.count += 1
    return lock


def _release(lock: _Lock, *, is_writer: bool) -> None:
    """Release a lock; the last release removes its file."""
    with _mutex:
        lock.count -= 1
        lock.has_writer = lock.has_writer and not is_writer
        if lock.count:
            return
        del _locks[_place(lock.path)]
        with contextlib.suppress(OSError):
            # Removed while it is locked, so that a process that waits for it finds that it is gone.
            if os.path.samestat(os.fstat(lock.descriptor), lock.path.lstat()):
                lock.path.unlink()
        os.close(lock.descriptor)


def _open_lock(target: Path, lock_path: Path) -> tuple[int, bool]:
    """Create and lock a lock file; return its descriptor, and False where the file system has no locks.

    Raises InUseError where another process holds the lock.
    """
    while True:
        with writing(target):
            descriptor = _opened(lock_path)
        try:
            is_exclusive = _lock_file(descriptor, target)
            if os.path.samestat(os.fstat(descriptor), lock_path.lstat()):
                with contextlib.suppress(OSError):
                    os.ftruncate(descriptor, 0)
                    os.pwrite(descriptor, _own_name().encode(errors="backslashreplace"), 0)
                return descriptor, is_exclusive
            # The holder removed the file before this process locked it.
            os.close(descriptor)
        except FileNotFoundError:
            os.close(descriptor)
        except BaseException:
            os.close(descriptor)
            raise


def _opened(lock_path: Path) -> int:
    """Open a lock file, made if missing. Raises OSError."""
    no_link = getattr(os, "O_NOFOLLOW", 0)
    try:
        return os.open(lock_path, os.O_RDWR | os.O_CREAT | no_link, 0o666)
    except PermissionError:
        # Another user's lock file, which a killed process has left, can still be locked.
        with contextlib.suppress(OSError):
            return os.open(lock_path, os.O_RDONLY | no_link)
        raise


def _lock_file(descriptor: int, target: Path) -> bool:
    """Lock an open file; False where there are no locks. Raises InUseError where another process holds the lock."""
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = os.pread(descriptor, 1000, 0).decode(errors="replace").strip() or "another process"
        raise InUseError(_in_use(target, owner)) from None
    except (ImportError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in _UNSUPPORTED:
            raise OutputError(f"{target}: cannot be locked: {error.strerror}") from error
        _warn_without_locks()
        return False
    return True


@functools.cache
def _warn_without_locks() -> None:
    """Warn that nothing keeps other processes from writing to the same output."""
    _log.warning(
        "warning: this file system has no locks; do not write one output from two processes at a time", extra=EARLY
    )


def _in_use(target: Path, owner: str) -> str:
    """Return the sentence on an output in use."""
    return f"{target}: is being written by {owner}; wait for it, or use another output"


def _own_name() -> str:
    """Return the process, host and command line, for the message of other processes."""
    program = Path(sys.argv[0]).name.replace("__main__.py", "octoreplay") or "python"
    command = without_credentials(shlex.join([program, *sys.argv[1:]]))
    return f"process {os.getpid()} on {socket.gethostname()} ({command[:300]})"


def _remove_leftovers(target: Path) -> None:
    """Remove the temporary files of processes that were killed while they held the lock."""
    prefix = re.escape(_hidden(target, "").name)
    with contextlib.suppress(OSError):
        for path in target.parent.iterdir():
            if re.fullmatch(prefix + r"[0-9a-f]{8}\.tmp", path.name):
                remove_temporary(path)


@atexit.register
def _clean_up() -> None:
    """Remove the temporary files of this process."""
    for path, process_id in tuple(_temporary_paths.items()):
        if process_id == os.getpid():
            remove_temporary(path)
