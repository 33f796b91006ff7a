"""On-disk cache of compiled kernels; a damaged file is found before its machine code is loaded.

numba's own cache does not check its files: a truncated index raises EOFError, a flipped bit in machine code crashes the
process, and two processes that compile at the same time can exchange their kernels.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import sys
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

logger = logging.getLogger(__name__)

SUFFIX = ".kernel"
_DIGEST_SIZE = hashlib.sha256().digest_size
_VERSIONS = (sys.implementation.cache_tag, numba.__version__, llvmlite.__version__)

_said: set[str] = set()
"""Kinds of warnings that this process gave: each is given once."""


class KernelCache:
    """Compiled versions of one kernel, a file for each signature and processor; the methods are those numba calls.

    A file holds the SHA-256 digest of its name and content, then the content. Its name tells kernel, signature,
    processor and versions apart, so that a file in the place of another one counts as damaged. A file that is damaged
    or cannot be read is compiled anew and replaced.
    """

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        self.cache_path = str(folder)
        self._folder = folder
        self._name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}"

    def load_overload(self, signature: tuple[Any, ...], target: Any) -> Any | None:
        """Return the compiled kernel for a signature; None where it has to be compiled."""
        target.refresh()
        path = self._path(signature, target.codegen())
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            _warn_once("unreadable", f"{path}: cannot be read ({error.strerror}); the kernel is compiled anew")
            return None
        content = memoryview(data)[_DIGEST_SIZE:]
        if data[:_DIGEST_SIZE] != _digest(path.name, content):
            _warn_once("damaged", f"{path}: this compiled kernel is damaged; it is compiled anew")
            return None
        return CompileResult._rebuild(target, *pickle.loads(content))  # noqa: SLF001 - as numba's own cache

    def save_overload(self, signature: tuple[Any, ...], result: Any) -> None:
        """Store a compiled kernel; where that fails, the kernel is compiled anew in the next run."""
        if result.library.has_dynamic_globals:
            # Its machine code holds addresses of this process.
            return
        path = self._path(signature, result.codegen)
        content = dumps(result._reduce())  # noqa: SLF001 - as numba's own cache
        temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            try:
                with temporary.open("xb") as file:
                    file.write(_digest(path.name, content))
                    file.write(content)
                temporary.replace(path)
            except OSError:
                temporary.unlink(missing_ok=True)
                raise
        except OSError as error:
            _warn_once(
                "unwritable",
                f"{self._folder}: compiled kernels cannot be stored ({error.strerror}); they are compiled anew in "
                "every run",
            )

    def _path(self, signature: tuple[Any, ...], codegen: Any) -> Path:
        """File of the kernel for a signature."""
        key = repr((_VERSIONS, codegen.magic_tuple(), signature))
        return self._folder / f"{self._name}-{hashlib.sha256(key.encode()).hexdigest()[:32]}{SUFFIX}"


def _digest(name: str, content: bytes | memoryview) -> bytes:
    """Digest of a file's name and content."""
    digest = hashlib.sha256(os.fsencode(name) + b"\0")
    digest.update(content)
    return digest.digest()


def _warn_once(kind: str, sentence: str) -> None:
    """Log a warning of a kind that was not given before."""
    if kind not in _said:
        _said.add(kind)
        logger.warning(sentence)
