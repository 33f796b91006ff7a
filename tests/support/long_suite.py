"""Choice of the parameters that the default suite leaves to the long one."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import pytest

long = pytest.mark.long


def one_in(step: int, *factors: Iterable[Any]) -> list[Any]:
    """Return every combination of some factors as parameters; the default suite runs one in ``step`` of them."""
    combinations = itertools.product(*factors)
    return [pytest.param(*values, marks=long if index % step else ()) for index, values in enumerate(combinations)]
