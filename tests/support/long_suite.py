"""Choice of the parameters that the default suite leaves to the long one."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import pytest

long = pytest.mark.long


def one_in(step: int, *factors: Iterable[Any]) -> list[Any]:
    """Every combination of some factors as parameters of a test; one in ``step`` is not left to the long suite.

    A step that has no divisor in common with the numbers of values takes every value of every factor.
    """
    combinations = itertools.product(*factors)
    return [pytest.param(*values, marks=long if index % step else ()) for index, values in enumerate(combinations)]
