"""Parameters and states of compiled code: numpy records, whose fields a class declares once.

Hundreds of fields pass into compiled code as a single argument. mypy checks them as attributes of
the class; numba reads and writes them as fields of the record.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import (
    Annotated,
    Any,
    ClassVar,
    Protocol,
    Self,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

import numpy as np
import numpy.typing as npt

from devices.arrays import ArrayRecord, Floats, Times

ColumnDict = dict[str, npt.NDArray[Any]]
"""Columns by name that a function fills: of estimates, or of an estimator's state."""
R_co = TypeVar("R_co", covariant=True)


class RecordArray(Protocol[R_co]):
    """Records of one type, (n,), in Python and in compiled code."""

    def __len__(self) -> int: ...
    @overload
    def __getitem__(self, key: int, /) -> R_co: ...
    @overload
    def __getitem__(self, key: str, /) -> npt.NDArray[Any]: ...
    def __setitem__(self, key: str | npt.NDArray[np.intp], value: Any, /) -> None: ...


class RecordMatrix(Protocol[R_co]):
    """Records of one type, (n, m), in compiled code."""

    def __len__(self) -> int: ...
    @overload
    def __getitem__(self, key: tuple[int, int], /) -> R_co: ...
    @overload
    def __getitem__(self, key: int, /) -> RecordArray[R_co]: ...


class KernelRecord:
    """Base of record types: each annotation declares a field, in this order.

    A field is `float`, `int`, a numpy scalar, another record type, or
    `Annotated[Floats, shape]` or `Annotated[Ints, shape]`. It begins with the value that the class
    gives it, else with zero. No instance of these classes exists.
    """

    @classmethod
    @cache
    def fields(cls) -> dict[str, Any]:
        """Return the annotations of the fields by name, in order."""
        hints = get_type_hints(cls, include_extras=True)
        return {name: hint for name, hint in hints.items() if get_origin(hint) is not ClassVar}

    @classmethod
    @cache
    def dtype(cls) -> np.dtype[np.void]:
        """Return the record's layout, the same object at each call.

        numba recognises its arguments by the layout's identity; it compares equal ones field by
        field at each call, which costs some 10 us. Aligned as the processor prefers.
        """
        fields = [(name, *_layout(hint)) for name, hint in cls.fields().items()]
        return np.dtype(fields, align=True)

    @classmethod
    def array(cls, n: int, **columns: Any) -> RecordArray[Self]:
        """Make n records with these columns, and the initial values elsewhere.

        Raises:
            ValueError: a column is no field, or does not fit.
        """
        made = np.zeros(n, cls.dtype())
        cls.fill_with_initial_values(made)
        for name, values in columns.items():
            made[name] = values
        return made

    @classmethod
    def fill_with_initial_values(cls, records: npt.NDArray[np.void]) -> None:
        """Set the fields that a class gives a value, also those of records within."""
        for name, hint in cls.fields().items():
            if isinstance(hint, type) and issubclass(hint, KernelRecord):
                hint.fill_with_initial_values(records[name])
            elif hasattr(cls, name):
                records[name] = getattr(cls, name)  # ANY: fields of the class itself


def _layout(hint: Any) -> tuple[Any, ...]:
    if get_origin(hint) is Annotated:
        kind, shape = get_args(hint)
        return (np.float64 if kind == Floats else np.int64, shape)
    if issubclass(hint, KernelRecord):
        return (hint.dtype(),)
    return ({float: np.float64, int: np.int64}.get(hint, hint),)


def view_records_as_bytes(column: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """View records as their bytes, (n, ...); return any other array unchanged. Copies nothing."""
    if column.dtype.names is None:
        return column
    return column.view(np.uint8).reshape(*column.shape, column.dtype.itemsize)


SIGMAS_95 = 1.96
"""Sigmas to each side of a 95 % interval."""


@dataclass(frozen=True)
class Estimates(ArrayRecord):
    """Estimates of n frames; the columns of `storage.schema.ESTIMATE_COLUMNS` in float64.

    Arrays are (n,), those of tiles (n, tiles). Undefined is NaN, contact 255.
    """

    seq: npt.NDArray[np.uint64]
    t_ns: Times
    gauge_kpa: Floats
    force_n: Floats
    force_sigma_n: Floats
    grf_n: Floats
    grf_sigma_n: Floats
    grf_lower_bound_n: Floats
    cop_x_m: Floats
    cop_y_m: Floats
    cop_sigma_x_m: Floats
    cop_sigma_y_m: Floats
    cop_index_x: Floats
    cop_index_y: Floats
    cop_ground_x_m: Floats
    cop_ground_y_m: Floats
    angle_rad: Floats
    contact: npt.NDArray[np.uint8]
    estimate_flags: npt.NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.seq)
