"""Constants and state of models, tile by tile: numpy records, which compiled code works on.

Hundreds of fields pass into compiled code as a single argument.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Records = npt.NDArray[np.void]
"""One record for every tile, or a single one; (n,)."""
Record = Any
"""One of them within compiled code, which reads and writes its fields as attributes."""
Columns = dict[str, npt.NDArray[Any]]


def record_type(fields: list[Any]) -> np.dtype[np.void]:
    """Type of a record with these fields, each where the processor likes it."""
    return np.dtype(fields, align=True)


def records(dtype: np.dtype[np.void], n: int, **columns: Any) -> Records:
    """N records with these columns, zero elsewhere.

    Raises:
        ValueError: there is no such column, or it does not fit.
    """
    made = np.zeros(n, dtype)
    for name, values in columns.items():
        made[name] = values
    return made


def as_bytes(column: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Records as the bytes that they are, (n, ...); what is no record as it is. Not copied."""
    if column.dtype.names is None:
        return column
    return column.view(np.uint8).reshape(*column.shape, column.dtype.itemsize)
