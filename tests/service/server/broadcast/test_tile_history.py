"""Each tile over the last minute: no peak hides, nothing is twice, and it is bounded."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.frames import FrameBatch
from service.server.broadcast.summary import (
    TILE_QUANTITIES,
    TILE_SPAN_PERIOD_NS,
    StreamHistory,
    reduce_tiles,
    summarize_force,
)
from tests.builders.arrays import PERIOD_NS
from tests.builders.frames import make_frames

BOOT = "1" * 32
FORCES_N = np.random.default_rng(0).normal(50.0, 20.0, (50_000, 2))
FORCES_N[::5] = np.nan


def add(history: StreamHistory, frames: FrameBatch, columns: dict[str, np.ndarray]) -> None:
    tiles = reduce_tiles(columns, frames.tile_count)
    history.add_span(summarize_force(frames, columns), tiles)


def newest(
    history: StreamHistory, seconds: float, unit: str, before_seq: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = history.get_tile_spans(seconds, before_seq)
    least, greatest = rows["extremes"][:, :, TILE_QUANTITIES.index(unit)].swapaxes(0, 1)
    return rows, least, greatest


def filled(runs: list[tuple[int, int]], tiles: int = 2) -> StreamHistory:
    """Runs of missing frames and frames; a newton is seven kilopascals."""
    recent, at = StreamHistory(BOOT, tiles), 0
    for gap, n in runs:
        at += gap
        frames = make_frames(np.arange(at, at + n), tiles)
        force_n = np.resize(FORCES_N[at : at + n], (n, tiles))
        columns = {"force_n": force_n, "gauge_kpa": 7 * force_n}
        add(recent, frames, columns)
        at += n
    return recent


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from([0, 0, 0, 1, 400]), st.integers(1, 60)), min_size=1),
    st.sampled_from(TILE_QUANTITIES),
)
def test_least_and_greatest_are_those_of_the_frames_to_half_a_part_in_a_thousand(
    runs: list[tuple[int, int]], unit: str
) -> None:
    rows, least, greatest = newest(filled(runs), 60.0, unit)
    by = 7 if unit == "gauge_kpa" else 1
    assert rows["n"].sum() == sum(n for _, n in runs)
    assert (rows["seq_first"][1:] > rows["seq"][:-1]).all()
    sent = {seq for gap, n, at in ends(runs) for seq in range(at + gap, at + gap + n)}
    for row, low, high in zip(rows, least, greatest, strict=True):
        force_n = FORCES_N[[seq for seq in range(row["seq_first"], row["seq"] + 1) if seq in sent]]
        assert len(force_n) == row["n"]
        for values, pick in ((low, np.fmin), (high, np.fmax)):
            wanted = by * pick.reduce(force_n, axis=0)
            assert values == pytest.approx(wanted, rel=5e-4, abs=1e-4, nan_ok=True)


def ends(runs: list[tuple[int, int]]) -> list[tuple[int, int, int]]:
    """Each with the number behind the one before it."""
    found, at = [], 0
    for gap, n in runs:
        found.append((gap, n, at))
        at += gap + n
    return found


def test_it_is_a_minute_in_tenths_of_a_second_and_no_more_of_it_than_is_asked_for() -> None:
    recent = filled([(0, 10)] * int(80e9 / (10 * PERIOD_NS)))
    rows, *_ = newest(recent, 60.0, "force_n")
    assert 590 <= len(rows) <= 602
    assert (np.diff(rows["t_ns"]) >= TILE_SPAN_PERIOD_NS - 10 * PERIOD_NS).all()
    some, *_ = newest(recent, 10.0, "force_n")
    assert 98 <= len(some) <= 101
    before = int(rows["seq_first"][300])
    older, *_ = newest(recent, 60.0, "force_n", before_seq=before)
    assert older["seq"][-1] == before - 1


@pytest.mark.parametrize(("tiles", "most"), [(8, 60_000), (64, 330_000)])
def test_what_it_costs_does_not_grow(tiles: int, most: int) -> None:
    recent = filled([(0, 30)] * 1200, tiles)
    assert 0.9 * most < recent._tiles.rows.nbytes < most


def test_without_estimates_and_without_frames_nothing_is_known() -> None:
    recent = StreamHistory(BOOT, 2)
    assert [len(each) for each in newest(recent, 60.0, "force_n")] == [0, 0, 0]
    frames = make_frames(5)
    add(recent, frames, {})
    rows, least, greatest = newest(recent, 60.0, "gauge_kpa")
    assert rows["n"].tolist() == [5]
    assert np.isnan(least).all()
    assert np.isnan(greatest).all()


def test_what_no_half_can_hold_is_the_greatest_it_can() -> None:
    recent = StreamHistory(BOOT, 1)
    columns = {"force_n": np.array([[1e9]]), "gauge_kpa": np.array([[-1e9]])}
    add(recent, make_frames(1, 1), columns)
    assert np.isfinite(newest(recent, 1.0, "force_n")[2]).all()
    assert np.isfinite(newest(recent, 1.0, "gauge_kpa")[1]).all()
