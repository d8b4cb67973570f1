"""Faults of single parts: in windows of time, and by hand."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.emulation.faults import Fault, scene_fault
from devices.scene import FaultKind, FaultScene


def window(kind: FaultKind, tile: str, t_s: float, duration_s: float) -> FaultScene:
    return FaultScene(kind=kind, tile=tile, t_s=t_s, duration_s=duration_s)


def test_a_fault_without_windows_is_never_there() -> None:
    fault = Fault()
    assert not any(fault(t_ns) for t_ns in (-1, 0, 10**18))


@settings(max_examples=50)
@given(
    windows=st.lists(
        st.tuples(st.integers(0, 1000), st.integers(1, 1000)).map(lambda w: (w[0], w[0] + w[1]))
    ),
    t_ns=st.integers(-10, 2100),
)
def test_a_fault_is_there_in_each_of_its_windows_and_nowhere_else(
    windows: list[tuple[int, int]], t_ns: int
) -> None:
    covered = {t for begin, end in windows for t in range(begin, end)}
    assert Fault(windows)(t_ns) == (t_ns in covered)


def test_a_scene_counts_the_time_of_a_fault_from_power_up() -> None:
    epoch_ns = 77_000_000_000
    fault = scene_fault([window("stale", "T01", 1.5, 0.25)], "stale", "T01", epoch_ns)
    assert not fault(1_600_000_000)
    assert not fault(epoch_ns + 1_499_999_999)
    assert fault(epoch_ns + 1_500_000_000)
    assert fault(epoch_ns + 1_749_999_999)
    assert not fault(epoch_ns + 1_750_000_000)


def test_a_fault_strikes_the_tile_and_in_the_way_that_the_scene_says() -> None:
    faults = [
        window("no_answer", "T01", 0.0, 1.0),
        window("stale", "T02", 2.0, 1.0),
        window("no_answer", "T01", 4.0, 1.0),
    ]
    struck = {
        (kind, tile): [
            t_s for t_s in range(6) if scene_fault(faults, kind, tile, 0)(t_s * 1_000_000_000)
        ]
        for kind in ("no_answer", "stale")
        for tile in ("T01", "T02")
    }
    assert struck == {
        ("no_answer", "T01"): [0, 4],
        ("no_answer", "T02"): [],
        ("stale", "T01"): [],
        ("stale", "T02"): [2],
    }


def test_a_fault_by_hand_lasts_as_long_as_its_block() -> None:
    fault = Fault([(100, 200)])
    with fault.injected():
        assert fault(0)
        assert fault(10**18)
        with fault.injected():
            assert fault(0)
        assert fault(0), "the outer block still runs"
    assert not fault(0)
    assert fault(150), "the window of the scene is still there"


def test_a_fault_by_hand_ends_although_its_block_failed() -> None:
    fault = Fault()

    def fail() -> None:
        with fault.injected():
            raise RuntimeError("in the block")

    with pytest.raises(RuntimeError, match="in the block"):
        fail()
    assert not fault(0)
