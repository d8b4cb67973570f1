"""A reference at any zoom: least and greatest are those of its frames, and gaps stay open."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import service.sessions.overview
import storage.sessions.comparisons
from service.sessions.overview import ComparisonSeries, ComparisonSeriesCache
from storage.formats.slice import Slice
from storage.sessions.comparisons import SERIES_NAME, SERIES_SCHEMA, write_comparison_series
from storage.sessions.pyramid import Bins

BEGIN_NS = 1_700_000_000_000_000_000


def series(t_ms: Any, ours_n: Any, reference_n: Any) -> pa.Table:
    n = len(t_ms)
    columns = [
        pa.array(BEGIN_NS + 1_000_000 * np.asarray(t_ms, np.int64), pa.int64()),
        pa.array(ours_n, pa.float32()),
        pa.array(reference_n, pa.float32()),
        pa.array([None] * n, pa.float32()),
        pa.array([0.0] * n, pa.float32()),
    ]
    return pa.table(columns, schema=SERIES_SCHEMA)


def kept(folder: Path, table: pa.Table) -> ComparisonSeries:
    write_comparison_series(folder / SERIES_NAME, table)
    found = ComparisonSeriesCache().get_or_read(folder)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("series")


def rows_of(bins: Bins, i: int, t_ms: np.ndarray) -> np.ndarray:
    first, last = ((bins[f"t_{of}_ns"][i] - BEGIN_NS) // 1_000_000 for of in ("first", "last"))
    return np.flatnonzero((t_ms >= first) & (t_ms <= last))


@settings(max_examples=40, deadline=None)
@given(
    steps=st.lists(st.sampled_from([2, 2, 2, 2, 2, 2, 90]), min_size=1, max_size=40),
    times=st.integers(1, 40),
    points=st.integers(1, 60),
    begin=st.integers(0, 300),
    length=st.integers(1, 3000),
)
def test_no_peak_of_the_reference_hides_and_no_bin_reaches_over_a_gap(
    folder: Path, steps: list[int], times: int, points: int, begin: int, length: int
) -> None:
    t_ms = np.cumsum([0, *(steps * times)])
    rng = np.random.default_rng(len(t_ms))
    ours_n, theirs_n = rng.normal(400.0, 300.0, (2, len(t_ms))).astype(np.float32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(storage.sessions.comparisons, "_GROUP_ROWS", 50)
        found = kept(folder, series(t_ms, ours_n, theirs_n))
    part = Slice(1e-3 * begin, 1e-3 * (begin + length))
    bins, size = found.get_bins(*part.compute_bounds_ns(BEGIN_NS), points)
    inside = np.flatnonzero((t_ms >= begin) & (t_ms < begin + length))
    rows = [rows_of(bins, i, t_ms) for i in range(len(bins["frames"]))]
    assert bins["frames"].tolist() == [len(each) for each in rows]
    assert bins["frames"].max(initial=0) <= size
    all_rows = np.concatenate([np.empty(0, np.int64), *rows]).tolist()
    assert all_rows == sorted(set(all_rows))
    assert set(inside.tolist()) <= set(all_rows)
    assert size == 1 or len(rows) >= points
    steps_break = np.median(np.diff(t_ms)) < 90
    for i, each in enumerate(rows):
        error_n = (ours_n - theirs_n)[each]
        assert bins["reference_grf_n_max"][i] == theirs_n[each].max()
        assert bins["reference_grf_n_min"][i] == theirs_n[each].min()
        assert (bins["error_n_min"][i], bins["error_n_max"][i]) == (error_n.min(), error_n.max())
        assert not steps_break or (np.diff(t_ms[each]) < 90).all()
    assert np.isnan(bins["reference_cop_x_m_max"]).all()


def test_a_zoom_costs_the_same_wherever_it_is_and_however_long_the_series(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    n = 300_000
    forces_n = np.arange(n) % 1000
    whole = kept(tmp_path, series(2 * np.arange(n), forces_n, forces_n))
    read: list[int] = []
    within = storage.sessions.comparisons.read_comparison_series_range

    def counted(folder: Path, footer: Any, *bounds_ns: int | None) -> pa.Table:
        read.append(len(storage.sessions.comparisons._find_row_groups(footer, *bounds_ns)))
        return within(folder, footer, *bounds_ns)

    monkeypatch.setattr(service.sessions.overview, "read_comparison_series_range", counted)
    for part in (Slice(), Slice(0.0, 550.0), Slice(100.0, 400.0)):
        bins, size = whole.get_bins(*part.compute_bounds_ns(BEGIN_NS), 500)
        assert 500 <= len(bins["frames"]) <= 2000 + 2
        assert size >= 64
        assert bins["error_n_max"].max() == 0.0
    assert read == []
    for start_s in (0.0, 300.0, 595.0):
        bins, size = whole.get_bins(*Slice(start_s, start_s + 2.0).compute_bounds_ns(BEGIN_NS), 800)
        assert (len(bins["frames"]), size) == (1000, 1)
    assert read == [1, 1, 1]


def test_a_series_is_read_again_only_when_it_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Path] = []
    whole = storage.sessions.comparisons.read_comparison_series

    def counted(folder: Path) -> pa.Table | None:
        read.append(folder)
        return whole(folder)

    monkeypatch.setattr(service.sessions.overview, "read_comparison_series", counted)
    series_kept = ComparisonSeriesCache()
    write_comparison_series(tmp_path / SERIES_NAME, series([0, 2], [1.0, 1.0], [2.0, 2.0]))
    first = series_kept.get_or_read(tmp_path)
    assert series_kept.get_or_read(tmp_path) is first
    write_comparison_series(tmp_path / SERIES_NAME, series([0, 2], [1.0, 1.0], [5.0, 2.0]))
    second = series_kept.get_or_read(tmp_path)
    assert second is not None
    assert second.get_bins(None, None, 10)[0]["reference_grf_n_max"].tolist() == [5.0, 2.0]
    assert len(read) == 2
    for folder in (tmp_path / str(i) for i in range(6)):
        folder.mkdir()
        write_comparison_series(folder / SERIES_NAME, series([0], [1.0], [1.0]))
        assert series_kept.get_or_read(folder) is not None
    assert len(series_kept._entries) == 4


def test_a_time_range_has_its_bins_and_an_empty_one_is_no_error(tmp_path: Path) -> None:
    table = kept(tmp_path, series(range(0, 100, 2), [1.0] * 50, [2.0] * 50))
    bins, size = table.get_bins(*Slice(start_s=0.01, end_s=0.02).compute_bounds_ns(BEGIN_NS), 100)
    assert size == 1
    assert ((bins["t_first_ns"] - BEGIN_NS) * 1e-6).tolist() == pytest.approx([10, 12, 14, 16, 18])
    bins, _ = table.get_bins(*Slice(start_s=5.0).compute_bounds_ns(BEGIN_NS), 100)
    assert {len(values) for values in bins.values()} == {0}


def test_bins_are_broken_where_something_is_missing(tmp_path: Path) -> None:
    t_ms = [*range(0, 20, 2), *range(100, 120, 2)]
    bins, size = kept(tmp_path, series(t_ms, [1.0] * 20, [2.0] * 20)).get_bins(None, None, 3)
    assert size == 4
    assert bins["frames"].tolist() == [4, 4, 2, 4, 4, 2]
    assert bins["missing"].tolist() == [0, 0, 0, 1, 0, 0]
    assert all(a < b for a, b in pairwise(bins["t_first_ns"].tolist()))
