"""Compilation and caching of kernels. Kernels trust their plain arrays; the wrappers check and coerce them."""

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
    """Folder of the compiled kernels, named after the content of all kernel files; None where none is writable.

    numba's own cache looks at one file at a time, and would keep a kernel whose callee in another file has changed.
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
    """Return True where the cache folder is writable and holds no compiled kernel."""
    return _CACHE_FOLDER is not None and not any(Path(_CACHE_FOLDER).rglob("*.nbi"))


def _compile(function: Callable[..., Any], **options: Any) -> Any:
    """Apply numba.njit, with the on-disk cache where a cache folder is writable.

    Without fast-math: reordered sums differ between callees linked from the cache and inlined ones, and the same input
    must give the same bytes. Loops over a brick compile to vector instructions where they sum element by element.
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
    """Compile a kernel that allocates no arrays.

    Without numba's runtime (``_nrt=False``) array references are not counted: counting takes two atomic operations at
    each use, which was half of the time of an iteration. A kernel that allocates arrays is an ``allocating_kernel``.
    numba does not document ``_nrt``; without the option kernels are slower and give the same results.
    """
    return _compile(function, _nrt=False)


def allocating_kernel(function: Callable[..., Any]) -> Any:
    """Compile a kernel that allocates arrays; for few and long calls."""
    return _compile(function)


def inline_kernel(function: Callable[..., Any]) -> Any:
    """Compile a kernel that is inlined into other kernels."""
    return _compile(function, inline="always", _nrt=False)
