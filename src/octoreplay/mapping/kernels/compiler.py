"""Compilation and caching of kernels. Kernels trust their plain arrays; the wrappers check and coerce them."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import njit

from octoreplay.mapping.kernels.kernel_cache import SUFFIX, KernelCache

logger = logging.getLogger(__name__)


_MAX_IDLE_SECONDS = 7 * 86_400
"""Time since its last use after which a folder of another version is removed from a shared place."""


def _cache_folder() -> Path | None:
    """Folder of the compiled kernels, named after the content of all kernel files; None where none is writable.

    A kernel contains its callees, so that a change in one file concerns the kernels of all.
    """
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    # No other version uses the package's own folder.
    places = {Path(__file__).parent / "__pycache__": 0}
    if os.environ.get("HOME"):
        places[Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "octoreplay"] = _MAX_IDLE_SECONDS
    if numba.config.CACHE_DIR:
        places = {Path(numba.config.CACHE_DIR): _MAX_IDLE_SECONDS}
    for place, max_idle_seconds in places.items():
        folder = place / f"kernels-{digest.hexdigest()[:16]}"
        is_new = not folder.exists()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # The time of the last use; refused where the folder is not writable.
            os.utime(folder)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            if is_new:
                logger.info("compiling kernels for this machine, which takes about 15 seconds; they are kept")
            _remove_others(folder, max_idle_seconds)
            return folder
    logger.warning("no folder for compiled kernels can be written; they are compiled anew in every run")
    return None


def _remove_others(folder: Path, max_idle_seconds: int) -> None:
    """Remove the cache folders beside this one that were not used for some time."""
    for other in folder.parent.glob("kernels-" + "[0-9a-f]" * 16):
        # Another process may remove it at the same time.
        with contextlib.suppress(OSError):
            if other != folder and time.time() - other.stat().st_mtime >= max_idle_seconds:
                shutil.rmtree(other, ignore_errors=True)


_CACHE_FOLDER = _cache_folder()


def cache_is_empty() -> bool:
    """Return True where the cache folder is writable and holds no compiled kernel."""
    return _CACHE_FOLDER is not None and not any(_CACHE_FOLDER.glob(f"*{SUFFIX}"))


def _compile(function: Callable[..., Any], **options: Any) -> Any:
    """Apply numba.njit, with the on-disk cache where a cache folder is writable.

    Without fast-math: reordered sums differ between callees linked from the cache and inlined ones, and the same input
    must give the same bytes. Loops over a brick compile to vector instructions where they sum element by element.
    """
    compiled = njit(**{"nogil": True, "error_model": "numpy", **options})(function)
    if _CACHE_FOLDER is not None and not numba.config.DISABLE_JIT:
        compiled._cache = KernelCache(function, _CACHE_FOLDER)  # noqa: SLF001 - numba offers no other way
    return compiled


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
