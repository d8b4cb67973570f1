"""Numpy array types, and records of arrays of one length."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Times = npt.NDArray[np.int64]
"""Instants or durations in nanoseconds: int64, because float64 rounds UTC to 200 ns."""
Bools = npt.NDArray[np.bool_]
Columns = Mapping[str, npt.NDArray[Any]]
"""Columns of a table by name, n rows each."""


@dataclass(frozen=True)
class ArrayRecord:
    """Base class of records whose fields are all arrays with the same first axis."""

    def slice_rows(self, start: int, stop: int) -> Self:
        """Return rows `start` to `stop` as views."""
        # `vars`, because `fields` takes longer than the views; this runs for every message.
        return type(self)(**{name: column[start:stop] for name, column in vars(self).items()})

    def select_rows(self, mask_or_rows: Bools | Ints) -> Self:
        """Return a copy of the rows selected by a mask or by row numbers."""
        return type(self)(**{f.name: getattr(self, f.name)[mask_or_rows] for f in fields(self)})

    def copy(self) -> Self:
        """Return a deep copy, with writable arrays."""
        return type(self)(**{f.name: getattr(self, f.name).copy() for f in fields(self)})

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Join `parts` along the first axis, in order.

        Raises:
            ValueError: no part, or arrays of different width.
        """
        columns = [vars(part) for part in parts]
        names = columns[0] if columns else [f.name for f in fields(cls)]
        return cls(**{name: np.concatenate([part[name] for part in columns]) for name in names})
