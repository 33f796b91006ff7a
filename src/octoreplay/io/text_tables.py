"""Reading of text tables: words, numbers, times and matrices; errors name file and line."""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from octoreplay.config.file_url import InputFile
from octoreplay.errors import InputError
from octoreplay.io.remote_files import local_copy
from octoreplay.records import Float64Array

_MAX_SECONDS = 1 << 32


def rows(path: InputFile) -> Iterator[tuple[str, list[str]]]:
    """Yield ('FILE line N', words) for each row of a text table; comments (#) and empty lines are skipped.

    Words are separated by spaces or commas. Raises InputError where the file cannot be read or is not text.
    """
    for number, line in enumerate(_read_text(path).splitlines(), start=1):
        fields = line.split("#", 1)[0].replace(",", " ").split()
        if fields:
            yield f"{path} line {number}", fields


def comments(path: InputFile) -> list[str]:
    """Return the comment lines (#) above the first row of a text table, without the sign.

    Raises InputError where the file cannot be read or is not text.
    """
    found = []
    for line in _read_text(path).splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            break
        found.append(line.strip().lstrip("#"))
    return found


def _read_text(path: InputFile) -> str:
    """Text of a file."""
    try:
        return local_copy(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a text file") from error


def floats(where: str, fields: list[str]) -> list[float]:
    """Convert words to numbers. Raises InputError, which begins with ``where``."""
    try:
        return [float(field) for field in fields]
    except ValueError:
        raise InputError(f"{where}: expects numbers, got '{' '.join(fields)}'") from None


def seconds_to_ns(where: str, text: str) -> int:
    """Convert a decimal number of seconds to integer nanoseconds without rounding to float. Raises InputError."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = Decimal("nan")
    # Checked before the multiplication: a number like 1e999999 would have millions of digits.
    if not seconds.is_finite() or seconds.copy_abs() >= _MAX_SECONDS:
        raise InputError(f"{where}: '{text}' is not a time in seconds")
    return int((seconds * 1_000_000_000).to_integral_value())


def read_matrix(path: Path, shapes: tuple[int, ...]) -> Float64Array:
    """Read a square matrix from a text file, (n, n) float64 with n one of ``shapes``. Raises InputError."""
    values = [value for where, fields in rows(path) for value in floats(where, fields)]
    for n in shapes:
        if len(values) == n * n:
            return np.array(values).reshape(n, n)
    expected = " or ".join(f"{n}x{n}" for n in shapes)
    raise InputError(f"{path}: expects a {expected} matrix, got {len(values)} numbers")
