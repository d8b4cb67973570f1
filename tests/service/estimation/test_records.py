"""Record types: fields as annotated, readable in Python and in compiled code."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
import pytest

from devices.arrays import Floats, Ints
from devices.jit import jit_cached
from service.estimation.records import KernelRecord, RecordArray


class Inner(KernelRecord):
    """Part of another record."""

    count: int


class Outer(KernelRecord):
    """Record with every kind of field."""

    seq: np.uint64
    inner: Inner
    force_n: float
    weights: Annotated[Floats, (3,)]
    limits: Annotated[Ints, (2,)]


class Begun(KernelRecord):
    """Record with initial values, and a fact of the class that is no field."""

    kind: ClassVar[str] = "begun"

    force_n: float = np.nan
    count: int
    number: int = -1


class Around(KernelRecord):
    """Record around another with initial values."""

    begun: Begun
    is_set: int


@jit_cached
def _add_up(records: RecordArray[Outer]) -> float:
    total = 0.0
    for i in range(len(records)):
        total += records[i].force_n * records[i].inner.count + records[i].weights[2]
        records[i].inner.count += records[i].limits[0]
    return total


def test_fields_have_the_types_and_the_order_of_the_annotations() -> None:
    dtype = Outer.dtype()
    assert dtype.names == ("seq", "inner", "force_n", "weights", "limits")
    assert dtype["seq"] == np.uint64
    assert dtype["inner"] == Inner.dtype()
    assert dtype["force_n"] == np.float64
    assert dtype["weights"] == np.dtype((np.float64, (3,)))
    assert dtype["limits"] == np.dtype((np.int64, (2,)))


def test_a_layout_is_one_object_which_numba_recognises_without_a_comparison() -> None:
    assert Outer.dtype() is Outer.dtype()
    assert Outer.array(1)["inner"].dtype is Inner.dtype()


def test_compiled_code_reads_and_writes_the_fields() -> None:
    records = Outer.array(2, force_n=[2.0, 3.0], weights=[[0, 0, 1], [0, 0, 5]], limits=[[7, 0]])
    records["inner"]["count"] = [10, 100]
    assert _add_up(records) == 2.0 * 10 + 1.0 + 3.0 * 100 + 5.0
    assert records["inner"]["count"].tolist() == [17, 107]


def test_fields_begin_with_the_values_of_their_class_also_within_another() -> None:
    records = Around.array(2, is_set=[0, 1])
    assert records["begun"].dtype.names == ("force_n", "count", "number")
    assert np.isnan(records["begun"]["force_n"]).all()
    assert records["begun"][["count", "number"]].tolist() == [(0, -1)] * 2
    assert Begun.array(1, number=3)["number"].tolist() == [3]


def test_a_column_that_is_no_field_is_refused() -> None:
    with pytest.raises(ValueError, match="force"):
        Outer.array(1, force=1.0)
