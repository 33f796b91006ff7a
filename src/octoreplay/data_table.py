"""Table of named columns: the form in which all results go to NumPy, pandas and Polars."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import UnionType
from typing import TYPE_CHECKING, Any, Self, get_args, get_type_hints

import numpy as np
import numpy.typing as npt

from octoreplay.errors import ConfigError

if TYPE_CHECKING:
    import pandas
    import polars

_TYPES: Mapping[Any, Any] = {bool: np.bool_, int: np.int64, float: np.float64, str: np.str_}
"""Types of columns by the type of a record's field."""


@dataclass(frozen=True, eq=False)
class Table:
    """Table of named columns with one row per record; ``table["agreement"]`` is a column, ``len(table)`` counts rows.

    Attributes
    ----------
    columns : mapping of str to (N,) array
        Columns by name: bool, int64, float64 or text (NumPy's str_), of maps also uint8 and float32. A number without
        a value is NaN, a text without a value is empty.
    """

    columns: Mapping[str, npt.NDArray[Any]]

    @classmethod
    def from_records(cls, kind: type, records: Sequence[Any], first: Mapping[str, npt.ArrayLike] | None = None) -> Self:
        """Return the table of some records of the dataclass ``kind``, such as the rows of ``check_result``.

        The columns are ``first``, then the fields whose type is bool, int, float or str, in their order; other fields
        are left out.
        """
        columns = {name: np.asarray(values) for name, values in (first or {}).items()}
        for name, hint in get_type_hints(kind).items():
            is_optional = isinstance(hint, UnionType)
            known = [part for part in get_args(hint) if part in _TYPES] if is_optional else [hint]
            if len(known) == 1 and known[0] in _TYPES:
                values = [getattr(record, name) for record in records]
                columns[name] = np.array(_filled(values, known[0]), dtype=_TYPES[known[0]])
        return cls(columns)

    @classmethod
    def from_rows(cls, names: Iterable[str], rows: Sequence[Mapping[str, Any]]) -> Self:
        """Return the table of rows by column name; a column has the type that fits all values of its rows."""
        return cls({name: _fitting([row.get(name) for row in rows]) for name in names})

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        return self.columns[name]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __repr__(self) -> str:
        return f"Table({len(self)} rows: {', '.join(self.columns)})"

    def to_numpy(self) -> npt.NDArray[Any]:
        """Return a structured array (N,) with one field per column."""
        rows = np.empty(len(self), dtype=[(name, values.dtype) for name, values in self.columns.items()])
        for name, values in self.columns.items():
            rows[name] = values
        return rows

    def to_pandas(self) -> pandas.DataFrame:
        """Return a pandas data frame. Raises ConfigError where pandas is not installed."""
        frame: pandas.DataFrame = _library("pandas").DataFrame(dict(self.columns))
        return frame

    def to_polars(self) -> polars.DataFrame:
        """Return a Polars data frame. Raises ConfigError where Polars is not installed."""
        frame: polars.DataFrame = _library("polars").DataFrame(dict(self.columns))
        return frame


def _filled(values: list[Any], kind: type) -> list[Any]:
    """Values with NaN or an empty text for None."""
    missing: Any = "" if kind is str else np.nan
    return [missing if value is None else value for value in values]


def _fitting(values: list[Any]) -> npt.NDArray[Any]:
    """Array of the first type of bool, int, float and text that holds all values."""
    kinds = {type(value) for value in values}
    for kind in (bool, int):
        if kinds == {kind}:
            return np.array(values, dtype=_TYPES[kind])
    if kinds <= {int, float, type(None)}:
        return np.array(_filled(values, float), dtype=np.float64)
    return np.array([str(value) for value in _filled(values, str)], dtype=np.str_)


def _library(name: str) -> Any:
    """Import an optional library."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ConfigError(f"{name} is not installed; use pip install {name}") from None
