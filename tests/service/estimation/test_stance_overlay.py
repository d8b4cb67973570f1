"""Curves of stances over their duration, with mean and spread."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from service.estimation.stance_curves import (
    OVERLAY_COLUMNS,
    Overlay,
    StanceOverlayBuilder,
    resample_stance,
    select_evenly,
)

NAN = float("nan")
STEPS_NS = st.lists(st.integers(1, 10_000_000), min_size=1, max_size=60)
FORCES = st.floats(-1e3, 1e3, width=32)


def sum_steps(steps_ns: list[int]) -> Any:
    return 1_700_000_000_000_000_000 + np.cumsum([0, *steps_ns])


@given(STEPS_NS, st.data(), st.integers(2, 300))
def test_a_curve_has_the_ends_and_the_range_of_its_frames(
    steps_ns: list[int], data: st.DataObject, points: int
) -> None:
    t_ns = sum_steps(steps_ns)
    force_n = data.draw(hnp.arrays(np.float64, len(t_ns), elements=FORCES))
    curve_n = resample_stance(t_ns, force_n, np.zeros(len(t_ns), bool), points)
    assert curve_n.shape == (points,)
    assert (curve_n[0], curve_n[-1]) == (force_n[0], force_n[-1])
    slack_n = 1e-12 * np.abs(force_n).max()
    assert curve_n.min() >= force_n.min() - slack_n
    assert curve_n.max() <= force_n.max() + slack_n


@given(STEPS_NS, st.integers(2, 300), st.floats(-100, 100), st.floats(-100, 100))
def test_a_straight_line_stays_straight(
    steps_ns: list[int], points: int, first_n: float, last_n: float
) -> None:
    t_ns = sum_steps(steps_ns)
    share = (t_ns - t_ns[0]) / (t_ns[-1] - t_ns[0])
    curve_n = resample_stance(
        t_ns, first_n + share * (last_n - first_n), np.zeros(len(t_ns), bool), points
    )
    assert curve_n == pytest.approx(np.linspace(first_n, last_n, points), abs=1e-9)


@given(STEPS_NS, st.data(), st.integers(2, 9))
def test_a_curve_does_not_depend_on_the_duration(
    steps_ns: list[int], data: st.DataObject, times: int
) -> None:
    t_ns = sum_steps(steps_ns)
    force_n = data.draw(hnp.arrays(np.float64, len(t_ns), elements=FORCES))
    slower = t_ns[0] + times * (t_ns - t_ns[0])
    one, other = (resample_stance(t, force_n, np.zeros(len(t), bool), 101) for t in (t_ns, slower))
    assert one == pytest.approx(other, abs=1e-6)


def test_a_missing_force_is_missing_up_to_its_neighbours() -> None:
    t_ns = sum_steps([1_000_000] * 4)
    unbroken = np.zeros(5, bool)
    curve = resample_stance(t_ns, np.array([1.0, 2.0, NAN, 4.0, 5.0]), unbroken, 9)
    assert curve.tolist()[:3] == [1.0, 1.5, 2.0]
    assert np.isnan(curve[3:6]).all()
    assert curve.tolist()[6:] == [4.0, 4.5, 5.0]


def test_a_curve_is_not_drawn_over_a_gap() -> None:
    t_ns = sum_steps([1_000_000, 2_000_000, 1_000_000])
    is_after_gap = np.array([True, False, True, False])
    curve = resample_stance(t_ns, np.array([1.0, 2.0, 4.0, 5.0]), is_after_gap, 9)
    assert curve[[0, 1, 2]].tolist() == [1.0, 1.5, 2.0]
    assert np.isnan(curve[3:6]).all()
    assert curve[[6, 7, 8]].tolist() == [4.0, 4.5, 5.0]


def make_recording(
    stances: list[npt.NDArray[np.float64]], part: list[int] | None = None
) -> tuple[npt.NDArray[np.int64], dict[str, npt.NDArray[Any]], list[tuple[int, int]]]:
    """Make frames 2 ms apart with five in flight before each stance, and the rows of stances."""
    forces: list[npt.NDArray[np.float64]] = []
    parts: list[int] = []
    rows: list[tuple[int, int]] = []
    for i, stance in enumerate(stances):
        begin = len(parts) + 5
        rows.append((begin, begin + len(stance) - 1))
        forces.append(np.concatenate([np.zeros(5), stance]))
        parts += [(part or [0] * len(stances))[i]] * len(forces[-1])
    force_n = np.concatenate(forces)
    t_ns = np.arange(len(force_n), dtype=np.int64) * 2_000_000
    columns: dict[str, npt.NDArray[Any]] = {
        "grf_n": force_n.astype(np.float32),
        "cop_x_m": np.where(force_n > 10, 0.01, NAN).astype(np.float32),
        "cop_y_m": np.zeros(len(force_n), np.float32),
        "estimate_flags": np.zeros(len(force_n), np.uint16),
        "part": np.array(parts, np.uint16),
    }
    return t_ns, columns, rows


def overlay(
    t_ns: Any, columns: Any, rows: list[tuple[int, int]], *, cuts: Sequence[int] = (), **how: Any
) -> Overlay:
    first, last = (np.array(each) for each in zip(*rows, strict=True))
    builder = StanceOverlayBuilder(
        columns["part"][first],
        t_ns[first],
        t_ns[last],
        points=how.get("points", 101),
        rows=how.get("kept", range(len(rows))),
    )
    edges = [0, *sorted(cut % len(t_ns) for cut in cuts), len(t_ns)]
    for begin, end in pairwise(edges):
        builder.add_frames(t_ns[begin:end], {name: v[begin:end] for name, v in columns.items()})
    return builder.build_overlay()


STANCES = st.lists(
    hnp.arrays(np.float64, st.integers(2, 40), elements=st.floats(1, 100, width=32)),
    min_size=1,
    max_size=6,
)


@pytest.mark.slow
@given(STANCES)
def test_mean_and_spread_are_of_the_curves(stances: list[npt.NDArray[np.float64]]) -> None:
    found = overlay(*make_recording(stances))
    assert found.rows.tolist() == list(range(len(stances)))
    for name in OVERLAY_COLUMNS:
        curves, spread = np.ma.masked_invalid(found.curves[name]), found.statistics[name]
        count = curves.count(axis=0)
        assert (spread.count == count).all()
        mean = np.where(count > 0, curves.mean(axis=0).filled(0.0), NAN)
        off = (curves - mean).filled(0.0)
        sd = np.where(count > 1, np.sqrt((off**2).sum(axis=0) / np.maximum(count - 1, 1)), NAN)
        assert spread.mean == pytest.approx(mean, rel=1e-9, abs=1e-12, nan_ok=True)
        assert spread.sd == pytest.approx(sd, rel=1e-6, abs=1e-9, nan_ok=True)


@given(STANCES, st.lists(st.integers(0, 10_000), max_size=8), st.booleans())
def test_any_batches_give_the_same_bits(
    stances: list[npt.NDArray[np.float64]], cuts: list[int], several: bool
) -> None:
    frames = make_recording(stances, list(range(len(stances))) if several else None)
    whole, pieces = overlay(*frames), overlay(*frames, cuts=cuts)
    for name in OVERLAY_COLUMNS:
        assert whole.curves[name].tobytes() == pieces.curves[name].tobytes()
        for field in ("mean", "sd", "count"):
            one, other = (getattr(o.statistics[name], field) for o in (whole, pieces))
            assert one.tobytes() == other.tobytes()


def test_mean_and_spread_are_of_all_stances() -> None:
    stances = [np.full(10, float(force)) for force in (10, 20, 30, 80)]
    found = overlay(*make_recording(stances), kept=[1])
    assert found.rows.tolist() == [1]
    assert found.curves["grf_n"].shape == (1, 101)
    assert found.statistics["grf_n"].mean == pytest.approx(np.full(101, 35.0))
    spread_n = np.std([10, 20, 30, 80], ddof=1)
    assert found.statistics["grf_n"].sd == pytest.approx(np.full(101, spread_n))


@given(st.integers(0, 5000), st.integers(1, 200))
def test_selected_rows_are_even_from_the_first_to_the_last(count: int, most: int) -> None:
    rows = select_evenly(count, most).tolist()
    assert len(rows) == len(set(rows)) == min(count, most)
    assert rows == sorted(rows)
    if most > 1 and count:
        assert (rows[0], rows[-1]) == (0, count - 1)
        assert max(np.diff(rows), default=1) - min(np.diff(rows), default=1) <= 1
