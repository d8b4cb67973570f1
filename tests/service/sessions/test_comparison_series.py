"""A reference at any zoom: least and greatest are those of its frames, and gaps stay open."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.sessions.comparison_series import bins_of_series
from storage.formats.slice import Slice
from storage.sessions.comparisons import SCHEMA

BEGIN_NS = 1_700_000_000_000_000_000


def series(t_ms: list[int], ours_n: list[float], reference_n: list[float]) -> pa.Table:
    n = len(t_ms)
    columns = [
        pa.array([BEGIN_NS + 1_000_000 * t for t in t_ms], pa.int64()),
        pa.array(ours_n, pa.float32()),
        pa.array(reference_n, pa.float32()),
        pa.array([None] * n, pa.float32()),
        pa.array([0.0] * n, pa.float32()),
    ]
    return pa.table(columns, schema=SCHEMA)


FORCES = st.lists(
    st.tuples(st.floats(-10, 900, width=32), st.floats(-10, 900, width=32)), min_size=1
)


@given(FORCES, st.integers(1, 60))
def test_no_peak_of_the_reference_hides_and_every_frame_is_in_one_bin(
    forces_n: list[tuple[float, float]], points: int
) -> None:
    ours_n, theirs_n = (np.array(each, np.float32) for each in zip(*forces_n, strict=True))
    n = len(ours_n)
    table = series(list(range(0, 2 * n, 2)), ours_n.tolist(), theirs_n.tolist())
    bins, size = bins_of_series(table, BEGIN_NS, Slice(), points)
    assert len(bins["frames"]) <= points
    assert bins["frames"].sum() == n
    assert bins["frames"].max() <= size
    starts = [0, *np.cumsum(bins["frames"]).tolist()]
    for i, (begin, end) in enumerate(pairwise(starts)):
        assert bins["t_first_ns"][i] == BEGIN_NS + 2_000_000 * begin
        assert bins["t_last_ns"][i] == BEGIN_NS + 2_000_000 * (end - 1)
        assert bins["reference_grf_n_max"][i] == theirs_n[begin:end].max()
        assert bins["reference_grf_n_min"][i] == theirs_n[begin:end].min()
        error_n = (ours_n - theirs_n)[begin:end]
        assert (bins["error_n_min"][i], bins["error_n_max"][i]) == (error_n.min(), error_n.max())
    assert np.isnan(bins["reference_cop_x_m_max"]).all()
    assert not bins["missing"].any()


def test_no_bin_reaches_over_a_gap() -> None:
    t_ms = [*range(0, 20, 2), *range(100, 120, 2)]
    table = series(t_ms, [1.0] * 20, [2.0] * 20)
    bins, size = bins_of_series(table, BEGIN_NS, Slice(), 3)
    assert size == 7
    assert bins["frames"].tolist() == [7, 3, 7, 3]
    assert bins["missing"].tolist() == [0, 0, 1, 0]


def test_what_is_asked_for_is_some_time_of_it_and_nothing_is_no_error() -> None:
    table = series(list(range(0, 100, 2)), [1.0] * 50, [2.0] * 50)
    bins, size = bins_of_series(table, BEGIN_NS, Slice(start_s=0.01, end_s=0.02), 100)
    assert size == 1
    assert ((bins["t_first_ns"] - BEGIN_NS) * 1e-6).tolist() == pytest.approx([10, 12, 14, 16, 18])
    bins, _ = bins_of_series(table, BEGIN_NS, Slice(start_s=5.0), 100)
    assert {len(values) for values in bins.values()} == {0}
