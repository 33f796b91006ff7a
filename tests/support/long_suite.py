"""Parameters and random examples that the default suite leaves to the long one."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from typing import Any

import pytest
from hypothesis import settings

long = pytest.mark.long

is_long_suite = False
"""True where pytest runs the long tests; ``conftest.py`` sets it before tests are collected."""


def one_in(step: int, *factors: Iterable[Any]) -> list[Any]:
    """Return every combination of some factors as parameters; the default suite runs one in ``step`` of them."""
    combinations = itertools.product(*factors)
    return [pytest.param(*values, marks=long if index % step else ()) for index, values in enumerate(combinations)]


def examples(number: int) -> Callable[[Any], Any]:
    """Return a decorator for a random test: an eighth of the examples in the default suite, all in the long one."""

    def decorate(test: Any) -> Any:
        max_examples = number if is_long_suite else -(-number // 8)
        return pytest.mark.examples(settings(max_examples=max_examples)(test))

    return decorate
