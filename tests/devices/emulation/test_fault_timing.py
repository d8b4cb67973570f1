"""Faults: their windows, and their activity between two calls."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import example, given, settings
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


@settings(max_examples=60)
@given(
    windows=st.lists(
        st.tuples(st.integers(0, 1000), st.integers(1, 1000)).map(lambda w: (w[0], w[0] + w[1])),
        max_size=4,
    ),
    since_ns=st.integers(-10, 2100),
    passed_ns=st.integers(1, 500),
)
@example([], -1, 10**6)
@example([(0, 5)], 5, 3)  # ended at the instant from which it is asked
@example([(8, 9)], 5, 3)  # begun at the last one
def test_a_fault_is_active_in_its_windows_only(
    windows: list[tuple[int, int]], since_ns: int, passed_ns: int
) -> None:
    active = {t for begin, end in windows for t in range(begin, end)}
    fault = begun(*((begin * 1e-9, end * 1e-9) for begin, end in windows))
    t_ns = since_ns + passed_ns
    assert fault(t_ns) == (t_ns in active)
    was_active = not active.isdisjoint(range(since_ns, t_ns + 1))
    assert fault.was_active_between(since_ns, t_ns) == was_active
    assert fault.is_possible == bool(windows)


def test_a_fault_of_the_first_instant_is_active_before_the_scene_begins_and_no_other() -> None:
    for t_s in (0.0, 0.001):
        faults = SceneFaults([of_tile("stale", "T01", t_s, 9.0)])
        assert faults.is_any_possible
        fault = faults.get_fault("stale", "T01")
        assert fault(1) == fault(EPOCH_NS) == (t_s == 0.0)
        faults.begin_scene_time(EPOCH_NS)
        assert fault(EPOCH_NS + 1_000_000)
        assert not fault(EPOCH_NS + 10 * S)
        assert faults.get_fault("stale", "T01") is fault


@pytest.mark.parametrize("asked_before", [False, True])
def test_the_time_of_a_fault_counts_from_the_beginning_of_the_scene(asked_before: bool) -> None:
    faults = SceneFaults([of_tile("stale", "T01", 1.5, 0.25)])
    if asked_before:
        faults.get_fault("stale", "T01")
    faults.begin_scene_time(EPOCH_NS)
    fault = faults.get_fault("stale", "T01")
    assert not fault(1_600_000_000)
    edges_ns = (1_499_999_999, 1_500_000_000, 1_749_999_999, 1_750_000_000)
    assert [fault(EPOCH_NS + t_ns) for t_ns in edges_ns] == [False, True, True, False]


def test_a_fault_has_the_kind_and_target_of_the_scene() -> None:
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
    # Where two overlap, the larger rate counts.
    assert rates == [0.0, 0.25, 0.5, 0.5, 0.0, 0.125]


def test_an_injected_fault_by_chance_has_the_default_rate() -> None:
    faults = SceneFaults([])
    assert faults.get_fault("nack_storm").get_rate(0) == 0.0
    with faults.inject("nack_storm", "bus"):
        assert faults.get_fault("nack_storm").get_rate(0) == 0.01


def test_an_injected_fault_lasts_as_long_as_its_block() -> None:
    fault = begun((100.0, 200.0))
    with suppress(RuntimeError), fault.inject():
        assert fault(0)
        assert fault(10**18)
        with fault.inject():
            assert fault(0)
        assert fault(0), "the outer block"
        raise RuntimeError
    assert not fault(0)
    assert fault(150 * S), "the window of the scene"


def test_an_injected_fault_is_reported_once_after_its_block() -> None:
    fault = FaultTiming()
    with fault.inject():
        pass
    assert fault.is_possible
    assert fault.was_active_between(0, 1)
    assert not fault.was_active_between(1, 2)


def test_a_fault_begins_once() -> None:
    fault = begun((1.0, 2.0))
    assert [fault.began_between(t * S, t * S + S) for t in range(4)] == [True, False, False, False]
    with fault.inject():
        assert fault.began_between(5 * S, 6 * S)
        assert not fault.began_between(6 * S, 7 * S)


def test_a_fault_that_was_ended_may_begin_again() -> None:
    fault = begun((1.0, 3.0), (5.0, 6.0))
    fault.end_at(2 * S)
    assert [fault(t * S) for t in range(7)] == [False, True, False, False, False, True, False]
    with fault.inject():
        fault.end_at(0)
        assert not fault(0)
    assert not fault(0)
    with fault.inject():
        assert fault(0)


def test_a_world_without_faults_has_none_until_one_is_injected() -> None:
    faults = SceneFaults(())
    assert not faults.is_any_possible
    with faults.inject("sda_low", "bus"):
        assert faults.is_any_possible
        assert faults.get_fault("sda_low")(0)
