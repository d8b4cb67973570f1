"""Faults: when they are there, and what has struck while nobody looked."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.emulation.fault_timing import FaultTiming, SceneFaults
from devices.scene.emulation_sections import FaultKind, FaultSection

S = 1_000_000_000
EPOCH_NS = 77 * S


def of_tile(kind: FaultKind, tile: str, t_s: float, duration_s: float) -> FaultSection:
    return FaultSection(kind=kind, tile=tile, t_s=t_s, duration_s=duration_s)


def begun(*windows_s: tuple[float, float]) -> FaultTiming:
    fault = FaultTiming(windows_s)
    fault.begin_scene_time(0)
    return fault


def test_a_fault_without_windows_is_never_there() -> None:
    fault = FaultTiming()
    fault.begin_scene_time(0)
    assert not any(fault(t_ns) for t_ns in (-1, 0, 10**18))
    assert not fault.was_active_between(-1, 10**18)
    assert not fault.is_possible


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
    assert fault.was_active_between(since_ns, t_ns) == any(
        t in covered for t in range(since_ns, t_ns + 1)
    )


def test_what_fails_from_the_first_instant_on_has_failed_before() -> None:
    faults = SceneFaults([of_tile("stale", "T01", 0.0, 9.0)])
    assert faults.get_fault("stale", "T01")(1)
    faults.begin_scene_time(EPOCH_NS)
    assert faults.get_fault("stale", "T01")(EPOCH_NS)
    assert not faults.get_fault("stale", "T01")(EPOCH_NS + 9 * S)


def test_before_a_scene_begins_nothing_else_fails() -> None:
    faults = SceneFaults([of_tile("stale", "T01", 0.001, 9.0)])
    assert faults.is_any_possible
    fault = faults.get_fault("stale", "T01")
    assert not fault(EPOCH_NS)
    faults.begin_scene_time(EPOCH_NS)
    assert fault(EPOCH_NS + 1_000_000)
    # And whoever asks for it only now gets the same one.
    assert faults.get_fault("stale", "T01") is fault


@pytest.mark.parametrize("asked_before", [False, True])
def test_a_scene_counts_the_time_of_a_fault_from_where_it_begins(asked_before: bool) -> None:
    faults = SceneFaults([of_tile("stale", "T01", 1.5, 0.25)])
    if asked_before:
        faults.get_fault("stale", "T01")
    faults.begin_scene_time(EPOCH_NS)
    fault = faults.get_fault("stale", "T01")
    assert not fault(1_600_000_000)
    assert not fault(EPOCH_NS + 1_499_999_999)
    assert fault(EPOCH_NS + 1_500_000_000)
    assert fault(EPOCH_NS + 1_749_999_999)
    assert not fault(EPOCH_NS + 1_750_000_000)


def test_a_fault_strikes_the_target_and_in_the_way_that_the_scene_says() -> None:
    faults = SceneFaults(
        [
            of_tile("no_answer", "T01", 0.0, 1.0),
            of_tile("stale", "T02", 2.0, 1.0),
            of_tile("no_answer", "T01", 4.0, 1.0),
            FaultSection(kind="brown_out", mux=0x71, t_s=3.0, duration_s=1.0),
            FaultSection(kind="sda_low", t_s=5.0, duration_s=1.0),
        ]
    )
    faults.begin_scene_time(0)
    targets = ("T01", "T02", "0x70", "0x71", "bus")
    kinds: tuple[FaultKind, ...] = ("no_answer", "stale", "brown_out", "sda_low")
    struck = {
        (kind, target): [t_s for t_s in range(6) if faults.get_fault(kind, target)(t_s * S)]
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
    faults = SceneFaults(
        [
            FaultSection(kind="bit_errors", t_s=0.0, duration_s=2.0, rate=0.25),
            FaultSection(kind="bit_errors", t_s=1.0, duration_s=2.0, rate=0.5),
            FaultSection(kind="bit_errors", t_s=5.0, duration_s=1.0, rate=0.125),
        ]
    )
    assert faults.get_fault("bit_errors").get_rate(EPOCH_NS) == 0.25, (
        "as at the scene's first instant"
    )
    faults.begin_scene_time(EPOCH_NS)
    rates = [
        faults.get_fault("bit_errors").get_rate(EPOCH_NS + round(t_s * S))
        for t_s in (-1, 0, 1, 2, 3, 5)
    ]
    # Where two overlap it happens as often as in the worse one.
    assert rates == [0.0, 0.25, 0.5, 0.5, 0.0, 0.125]


def test_a_fault_by_chance_by_hand_has_the_scene_files_default() -> None:
    faults = SceneFaults([])
    assert faults.get_fault("nack_storm").get_rate(0) == 0.0
    with faults.inject("nack_storm", "bus"):
        assert faults.get_fault("nack_storm").get_rate(0) == 0.01


def test_a_fault_by_hand_lasts_as_long_as_its_block() -> None:
    fault = begun((100.0, 200.0))
    with fault.inject():
        assert fault(0)
        assert fault(10**18)
        with fault.inject():
            assert fault(0)
        assert fault(0), "the outer block still runs"
    assert not fault(0)
    assert fault(150 * S), "the window of the scene is still there"


def test_a_fault_by_hand_is_remembered_once_by_who_was_not_asked_meanwhile() -> None:
    fault = FaultTiming()
    with fault.inject():
        pass
    assert fault.is_possible
    assert fault.was_active_between(0, 1)
    assert not fault.was_active_between(1, 2)


def test_what_sets_in_does_so_once() -> None:
    fault = begun((1.0, 2.0))
    assert [fault.began_between(t * S, t * S + S) for t in range(4)] == [True, False, False, False]
    with fault.inject():
        assert fault.began_between(5 * S, 6 * S)
        assert not fault.began_between(6 * S, 7 * S)


def test_what_was_mended_is_over_and_may_come_again() -> None:
    fault = begun((1.0, 3.0), (5.0, 6.0))
    fault.end_at(2 * S)
    assert [fault(t * S) for t in range(7)] == [False, True, False, False, False, True, False]
    with fault.inject():
        fault.end_at(0)
        assert not fault(0)
    assert not fault(0)
    with fault.inject():
        assert fault(0)


def test_a_fault_by_hand_ends_although_its_block_failed() -> None:
    fault = FaultTiming()

    def fail() -> None:
        with fault.inject():
            raise RuntimeError("in the block")

    with pytest.raises(RuntimeError, match="in the block"):
        fail()
    assert not fault(0)


def test_a_world_without_faults_has_none_until_one_is_injected() -> None:
    faults = SceneFaults(())
    assert not faults.is_any_possible
    with faults.inject("sda_low", "bus"):
        assert faults.is_any_possible
        assert faults.get_fault("sda_low")(0)
