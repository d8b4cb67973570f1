"""`skew`: every tile's value at the instant of its frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.models.skew import SkewState, interpolate_to_frame


def align(
    values: list[float], t_ns: list[int], frame_t_ns: list[int], broken: Sequence[int] = ()
) -> list[float]:
    state = SkewState.array(1)[0]
    frames = enumerate(zip(values, t_ns, frame_t_ns, strict=True))
    return [float(interpolate_to_frame(state, *frame, i in broken)) for i, frame in frames]


@given(
    late_ns=st.integers(0, 2_000_000),
    rise_n=st.floats(-10, 10),
    steps_ns=st.lists(st.integers(2_000_000, 60 * 10**9), min_size=2, max_size=20),
)
def test_a_straight_line_is_aligned_exactly(
    late_ns: int, rise_n: float, steps_ns: list[int]
) -> None:
    frame_ns = np.cumsum(steps_ns)
    sampled_ns = frame_ns + late_ns
    out = align((rise_n * sampled_ns * 1e-9).tolist(), sampled_ns.tolist(), frame_ns.tolist())
    assert out[1:] == pytest.approx(rise_n * frame_ns[1:] * 1e-9, abs=1e-9)


@pytest.mark.parametrize("t_ns", [[0, 10, 20], [10, 10, 4]], ids=["later", "at once or back"])
def test_a_tile_sampled_with_its_frame_keeps_its_values(t_ns: list[int]) -> None:
    assert align([1.0, 5.0, 2.0], t_ns, t_ns) == [1.0, 5.0, 2.0]


def test_no_line_crosses_a_gap_or_a_missing_value() -> None:
    values, t_ns = [0.0, 4.0, 8.0, math.nan, 4.0, 8.0], [5, 15, 25, 35, 45, 55]
    out = align(values, t_ns, [t - 5 for t in t_ns], broken=[2])
    assert out == pytest.approx([0.0, 2.0, 8.0, math.nan, 4.0, 6.0], nan_ok=True)


@pytest.mark.parametrize("frame_ns", [-1, 4, 21, 10**18])
def test_an_instant_outside_two_samples_keeps_the_value(frame_ns: int) -> None:
    assert align([1.0, 3.0], [5, 20], [0, frame_ns])[1] == 3.0
