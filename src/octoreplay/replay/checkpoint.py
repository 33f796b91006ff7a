"""Check points: the state of a run between two ticks, from which ``--resume`` continues it.

A check point is a file beside the partial result (docs/reliability.md). It holds a pickle, because the parts of a run
share maps and versions of maps. Loading it creates NumPy arrays and objects of this package's classes; every other name
is refused.
"""

from __future__ import annotations

import contextlib
import io
import logging
import pickle
import platform
import struct
import time
from collections.abc import Mapping
from enum import Enum
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import zstandard
from isal import isal_zlib

from octoreplay._version import __version__
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.mcap_writer import Written
from octoreplay.io.output_file import OutputFile, replacing, writing
from octoreplay.io.results.result_writer import ResultWriter, partial_path
from octoreplay.replay.recorder import Recorder
from octoreplay.replay.session import Session

COST = 0.03
"""Largest share of a run's time that check points take by default."""
GROWTH = 1.5
"""Factor on the time of the last check point that gives the expected time of the next one."""
FIRST_SECONDS = 0.2
"""Expected time of the first check point [s]."""

_MAGIC = b"OCTC\x01"
_CHECKSUM = struct.Struct("<I")
_ZSTD_LEVEL = 1
_PIECE_BYTES = 1 << 20
_ROOMS = ("replay", "mapping", "registration", "config", "records", "run_metrics")
"""Parts of this package whose classes a check point may use; making an object of them opens no file."""
_OTHERS = {
    ("builtins", "set"), ("builtins", "frozenset"), ("collections", "deque"), ("numpy", "ndarray"), ("numpy", "dtype"),
    ("numpy._core.multiarray", "_reconstruct"), ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"), (__name__, "_random_generator"), (Written.__module__, "Written"),
    (Written.__module__, "WrittenMessage"),
}  # fmt: skip
"""Other names that a check point may use."""

_log = logging.getLogger(__name__)


def checkpoint_path(output: Path) -> Path:
    """Return the path of the check point of a result: ``x.checkpoint`` for ``x.mcap``."""
    return output.with_name(f"{output.stem if output.suffix == '.mcap' else output.name}.checkpoint")


def can_resume(output: Path) -> bool:
    """Return True where an interrupted run left a partial result and a check point."""
    return checkpoint_path(output).exists() and partial_path(output).exists()


class Checkpoints:
    """Check points of one run.

    ``every`` is the least time between them [s], 0 for none; by default they take at most COST of the run's time.
    """

    def __init__(self, session: Session, recorder: Recorder, writer: ResultWriter, every: float | None) -> None:
        self.path = checkpoint_path(writer.path)
        self._session = session
        self._recorder = recorder
        self._writer = writer
        self._every = every
        self._started = self._ended = time.monotonic()
        self._spent, self._expected = 0.0, FIRST_SECONDS

    def restore(self) -> None:
        """Continue the run after its check point. Raises InputError and ConfigError where that is not possible."""
        content = load_state(self.path, self._session.shared)
        self._writer.take_over(content["written"])
        self._session.restore(content["session"])
        self._recorder.restore(content["recorder"])
        last = self._recorder.last
        assert last is not None
        elapsed = (last.stamp_ns - self._recorder.start_ns) / 1e9
        _log.info("%s: continues after tick %d, %.1f s of log time", self._writer.path, last.number, elapsed)

    def save_if_due(self) -> None:
        """Save a check point if enough time has passed since the last one."""
        now = time.monotonic()
        if self._every is None:
            is_due = self._spent + self._expected <= COST * (now - self._started)
        else:
            is_due = now - self._ended >= self._every
        if is_due:
            self.save()

    def save(self) -> None:
        """Save the state after the last tick. Raises OutputError."""
        if self._every == 0:
            return
        started = time.monotonic()
        recorder = self._recorder.state()
        content = {"recorder": recorder, "written": self._writer.sync(), "session": self._session.state()}
        # It is also saved after an interrupt.
        save_state(self.path, content, self._session.shared)
        self._ended = time.monotonic()
        self._spent += self._ended - started
        self._expected = GROWTH * (self._ended - started)

    def remove(self) -> None:
        """Remove the check point of a complete run, or of an earlier one."""
        with writing(self.path):
            self.path.unlink(missing_ok=True)


class _SummedFile:
    """File for writing, with the CRC-32 of what was written."""

    def __init__(self, file: OutputFile) -> None:
        self._file = file
        self.crc = 0

    def write(self, data: bytes) -> int:
        """Write some bytes and return their number."""
        self.crc = isal_zlib.crc32(data, self.crc)
        return self._file.write(data)


def save_state(path: Path, content: Mapping[str, Any], shared: Mapping[str, object]) -> None:
    """Write a check point with the states of a run's parts: magic, zstd frame with a pickle, CRC-32 of both.

    ``shared`` are the objects that the states refer to, but do not contain, by name. Raises OutputError.
    """
    with replacing(path) as temporary, OutputFile(temporary) as file:
        summed = _SummedFile(file)
        summed.write(_MAGIC)
        stream = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).stream_writer(cast("IO[bytes]", summed), closefd=False)
        with stream:
            _SharingPickler(stream, shared).dump({**content, "versions": _versions()})
        file.write(_CHECKSUM.pack(summed.crc))


def load_state(path: Path, shared: Mapping[str, object]) -> dict[str, Any]:
    """Return the content of a check point. Raises InputError and ConfigError where it cannot be used."""
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(path.open("rb"))
            is_whole = _is_whole(file)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        if not is_whole:
            raise InputError(f"{path}: damaged, or no check point; run with --restart to start from the beginning")
        file.seek(len(_MAGIC))
        try:
            content = _Unpickler(zstandard.ZstdDecompressor().stream_reader(file), shared).load()
        except Exception as error:
            # Classes of another version may fail in any way.
            raise InputError(
                f"{path}: cannot be read by this version; run with --restart to start from the beginning"
            ) from error
    if not isinstance(content, dict) or content.get("versions") != _versions():
        raise ConfigError(
            f"{path}: was written by other versions of octoreplay, Python or NumPy, which may give another result; use"
            " those, or run with --restart to start from the beginning"
        )
    return content


def pickled(content: Mapping[str, Any]) -> bytes:
    """Return the pickle of a mapping without shared objects."""
    buffer = io.BytesIO()
    _Pickler(buffer, protocol=5).dump(content)
    return buffer.getvalue()


def unpickled(data: bytes) -> dict[str, Any]:
    """Return the mapping of a pickle. Raises UnpicklingError for other data, and for names that are not allowed."""
    content = _Unpickler(io.BytesIO(data), {}).load()
    if not isinstance(content, dict):
        raise pickle.UnpicklingError("holds no mapping")
    return content


def _is_whole(file: IO[bytes]) -> bool:
    """Return True if the magic bytes and the checksum of a check point are right."""
    size = file.seek(0, io.SEEK_END) - _CHECKSUM.size
    file.seek(0)
    if size < len(_MAGIC) or file.read(len(_MAGIC)) != _MAGIC:
        return False
    crc = isal_zlib.crc32(_MAGIC)
    for place in range(len(_MAGIC), size, _PIECE_BYTES):
        crc = isal_zlib.crc32(file.read(min(_PIECE_BYTES, size - place)), crc)
    return file.read() == _CHECKSUM.pack(crc)


def _versions() -> dict[str, str]:
    """Return the versions that may change the bytes of a result."""
    packages = ("numpy", "numba", "mcap", "rosbags", "zstandard")
    return {"octoreplay": __version__, "python": platform.python_version()} | {name: version(name) for name in packages}


class _Pickler(pickle.Pickler):
    """Pickler whose pickles ``_Unpickler`` reads."""

    def reducer_override(self, value: Any) -> Any:
        """Reduce random generators to numbers, and members of enumerations to class and value."""
        if isinstance(value, np.random.Generator):
            return _random_generator, (value.bit_generator.state,)
        if isinstance(value, Enum):
            # Some versions of Python reduce them to a call of getattr.
            return type(value), (value.value,)
        return NotImplemented


class _SharingPickler(_Pickler):
    """Pickler that replaces ``shared`` objects by their names."""

    def __init__(self, file: IO[bytes], shared: Mapping[str, object]) -> None:
        super().__init__(file, protocol=5)
        self._names = {id(value): name for name, value in shared.items()}

    def persistent_id(self, value: object) -> str | None:
        return self._names.get(id(value))


def _random_generator(state: Any) -> np.random.Generator:
    """Random generator of a state."""
    generator = np.random.default_rng(0)
    generator.bit_generator.state = state
    return generator


class _Unpickler(pickle.Unpickler):
    """Unpickler that creates only classes of this package and NumPy arrays."""

    def __init__(self, file: Any, shared: Mapping[str, object]) -> None:
        super().__init__(file)
        self._shared = shared

    def persistent_load(self, name: str) -> object:
        return self._shared[name]

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _OTHERS:
            return super().find_class(module, name)
        package, _, rest = module.partition(".")
        if package == "octoreplay" and rest.partition(".")[0] in _ROOMS and "." not in name:
            found = super().find_class(module, name)
            if isinstance(found, type) and found.__module__ == module:
                return found
        raise pickle.UnpicklingError(f"'{module}.{name}' is not allowed in a check point")
