"""How kernels are compiled and kept: they take plain arrays and trust them; the wrappers check and coerce."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import njit

logger = logging.getLogger(__name__)


def _cache_folder() -> str | None:
    """Where compiled kernels are kept: a folder named after the content of all kernel files; None where none can be.

    numba's own rule looks at one file at a time, and would keep a kernel whose callee in another file has changed.
    """
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    places = [Path(__file__).parent / "__pycache__"]
    if os.environ.get("HOME"):
        places.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "octoreplay")
    if numba.config.CACHE_DIR:
        places = [Path(numba.config.CACHE_DIR)]
    for place in places:
        folder = place / f"kernels-{digest.hexdigest()[:16]}"
        is_new = not folder.exists()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            if is_new:
                logger.info("compiling kernels for this machine, which takes about 15 seconds; they are kept")
            return str(folder)
    logger.warning("no folder for compiled kernels can be written; they are compiled anew in every run")
    return None


_CACHE_FOLDER = _cache_folder()


def cache_is_empty() -> bool:
    """True where compiled kernels can be kept, and none is yet."""
    return _CACHE_FOLDER is not None and not any(Path(_CACHE_FOLDER).rglob("*.nbi"))


def _compile(function: Callable[..., Any], **options: Any) -> Any:
    """numba.njit with the on-disk cache where a cache folder can be written, without it elsewhere.

    No fast-math: reordered sums come out differently when callees are linked from the cache instead of inlined, and
    the same input must give the same bytes. Loops over a brick run as vectors when they sum element by element.
    """
    settings = {"nogil": True, "error_model": "numpy", **options}
    if _CACHE_FOLDER is None:
        return njit(**settings)(function)
    users_folder = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _CACHE_FOLDER
    try:
        return njit(cache=True, **settings)(function)
    finally:
        numba.config.CACHE_DIR = users_folder


def kernel(function: Callable[..., Any]) -> Any:
    """Compile for plain arrays, all of which are passed.

    Without numba's own memory arrays are not counted: each use would take two atomic operations, which was half of the
    time of an iteration. A kernel that makes arrays is an ``allocating_kernel``. numba has the option ``_nrt`` for its
    own tests and does not document it; without it the kernels are the same, and slower.
    """
    return _compile(function, _nrt=False)


def allocating_kernel(function: Callable[..., Any]) -> Any:
    """Compile for plain arrays, with arrays of its own; for few and long calls."""
    return _compile(function)


def inline_kernel(function: Callable[..., Any]) -> Any:
    """Compile for use inside other kernels."""
    return _compile(function, inline="always", _nrt=False)
