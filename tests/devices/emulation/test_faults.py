"""Faults: when they are there, and what has struck while nobody looked."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.emulation.faults import Fault, Faults
from devices.scene.emulated import FaultKind, FaultScene

S = 1_000_000_000
EPOCH_NS = 77 * S


def of_tile(kind: FaultKind, tile: str, t_s: float, duration_s: float) -> FaultScene:
    return FaultScene(kind=kind, tile=tile, t_s=t_s, duration_s=duration_s)


def begun(*windows_s: tuple[float, float]) -> Fault:
    fault = Fault(windows_s)
    fault.begin(0)
    return fault


def test_a_fault_without_windows_is_never_there() -> None:
    fault = Fault()
    fault.begin(0)
    assert not any(fault(t_ns) for t_ns in (-1, 0, 10**18))
    assert not fault.struck(-1, 10**18)
    assert not fault.possible


windows = st.lists(
    st.tuples(st.integers(0, 1000), st.integers(1, 1000)).map(lambda w: (w[0], w[0] + w[1])),
    max_size=4,
)


@settings(max_examples=50)
@given(windows=windows, t_ns=st.integers(-10, 2100))
def test_a_fault_is_there_in_each_of_its_windows_and_nowhere_else(
    windows: list[tuple[int, int]], t_ns: int
) -> None:
    covered = {t for begin, end in windows for t in range(begin, end)}
    fault = begun(*((begin * 1e-9, end * 1e-9) for begin, end in windows))
    assert fault(t_ns) == (t_ns in covered)


@settings(max_examples=50)
@given(windows=windows, since_ns=st.integers(-10, 2100), passed_ns=st.integers(1, 500))
def test_it_has_struck_if_it_was_there_at_any_instant_since(
    windows: list[tuple[int, int]], since_ns: int, passed_ns: int
) -> None:
    covered = {t for begin, end in windows for t in range(begin, end)}
    fault = begun(*((begin * 1e-9, end * 1e-9) for begin, end in windows))
    t_ns = since_ns + passed_ns
    assert fault.struck(since_ns, t_ns) == any(t in covered for t in range(since_ns, t_ns + 1))


def test_what_fails_from_the_first_instant_on_has_failed_before() -> None:
    faults = Faults([of_tile("stale", "T01", 0.0, 9.0)])
    assert faults.of("stale", "T01")(1)
    faults.begin(EPOCH_NS)
    assert faults.of("stale", "T01")(EPOCH_NS)
    assert not faults.of("stale", "T01")(EPOCH_NS + 9 * S)


def test_before_a_scene_begins_nothing_else_fails() -> None:
    faults = Faults([of_tile("stale", "T01", 0.001, 9.0)])
    assert faults.possible
    fault = faults.of("stale", "T01")
    assert not fault(EPOCH_NS)
    faults.begin(EPOCH_NS)
    assert fault(EPOCH_NS + 1_000_000)
    # And whoever asks for it only now gets the same one.
    assert faults.of("stale", "T01") is fault


@pytest.mark.parametrize("asked_before", [False, True])
def test_a_scene_counts_the_time_of_a_fault_from_where_it_begins(asked_before: bool) -> None:
    faults = Faults([of_tile("stale", "T01", 1.5, 0.25)])
    if asked_before:
        faults.of("stale", "T01")
    faults.begin(EPOCH_NS)
    fault = faults.of("stale", "T01")
    assert not fault(1_600_000_000)
    assert not fault(EPOCH_NS + 1_499_999_999)
    assert fault(EPOCH_NS + 1_500_000_000)
    assert fault(EPOCH_NS + 1_749_999_999)
    assert not fault(EPOCH_NS + 1_750_000_000)


def test_a_fault_strikes_the_target_and_in_the_way_that_the_scene_says() -> None:
    faults = Faults(
        [
            of_tile("no_answer", "T01", 0.0, 1.0),
            of_tile("stale", "T02", 2.0, 1.0),
            of_tile("no_answer", "T01", 4.0, 1.0),
            FaultScene(kind="brown_out", mux=0x71, t_s=3.0, duration_s=1.0),
            FaultScene(kind="sda_low", t_s=5.0, duration_s=1.0),
        ]
    )
    faults.begin(0)
    targets = ("T01", "T02", "0x70", "0x71", "bus")
    kinds: tuple[FaultKind, ...] = ("no_answer", "stale", "brown_out", "sda_low")
    struck = {
        (kind, target): [t_s for t_s in range(6) if faults.of(kind, target)(t_s * S)]
        for kind in kinds
        for target in targets
    }
    assert {what: when for what, when in struck.items() if when} == {
        ("no_answer", "T01"): [0, 4],
        ("stale", "T02"): [2],
        ("brown_out", "0x71"): [3],
        ("sda_low", "bus"): [5],
    }


def test_the_rate_of_a_fault_by_chance_is_that_of_its_window() -> None:
    faults = Faults(
        [
            FaultScene(kind="bit_errors", t_s=0.0, duration_s=2.0, rate=0.25),
            FaultScene(kind="bit_errors", t_s=1.0, duration_s=2.0, rate=0.5),
            FaultScene(kind="bit_errors", t_s=5.0, duration_s=1.0, rate=0.125),
        ]
    )
    assert faults.of("bit_errors").rate(EPOCH_NS) == 0.25, "as at the scene's first instant"
    faults.begin(EPOCH_NS)
    rates = [faults.of("bit_errors").rate(EPOCH_NS + round(t_s * S)) for t_s in (-1, 0, 1, 2, 3, 5)]
    # Where two overlap it happens as often as in the worse one.
    assert rates == [0.0, 0.25, 0.5, 0.5, 0.0, 0.125]


def test_a_fault_by_chance_by_hand_has_the_scene_files_default() -> None:
    faults = Faults([])
    assert faults.of("nack_storm").rate(0) == 0.0
    with faults.injected("nack_storm", "bus"):
        assert faults.of("nack_storm").rate(0) == 0.01


def test_a_fault_by_hand_lasts_as_long_as_its_block() -> None:
    fault = begun((100.0, 200.0))
    with fault.injected():
        assert fault(0)
        assert fault(10**18)
        with fault.injected():
            assert fault(0)
        assert fault(0), "the outer block still runs"
    assert not fault(0)
    assert fault(150 * S), "the window of the scene is still there"


def test_a_fault_by_hand_is_remembered_once_by_who_was_not_asked_meanwhile() -> None:
    fault = Fault()
    with fault.injected():
        pass
    assert fault.possible
    assert fault.struck(0, 1)
    assert not fault.struck(1, 2)


def test_what_sets_in_does_so_once() -> None:
    fault = begun((1.0, 2.0))
    assert [fault.set_in(t * S, t * S + S) for t in range(4)] == [True, False, False, False]
    with fault.injected():
        assert fault.set_in(5 * S, 6 * S)
        assert not fault.set_in(6 * S, 7 * S)


def test_what_was_mended_is_over_and_may_come_again() -> None:
    fault = begun((1.0, 3.0), (5.0, 6.0))
    fault.clear(2 * S)
    assert [fault(t * S) for t in range(7)] == [False, True, False, False, False, True, False]
    with fault.injected():
        fault.clear(0)
        assert not fault(0)
    assert not fault(0)
    with fault.injected():
        assert fault(0)


def test_a_fault_by_hand_ends_although_its_block_failed() -> None:
    fault = Fault()

    def fail() -> None:
        with fault.injected():
            raise RuntimeError("in the block")

    with pytest.raises(RuntimeError, match="in the block"):
        fail()
    assert not fault(0)


def test_a_world_without_faults_has_none_until_one_is_injected() -> None:
    faults = Faults(())
    assert not faults.possible
    with faults.injected("sda_low", "bus"):
        assert faults.possible
        assert faults.of("sda_low")(0)
