"""Tares that were taken while a recording ran, and recordings that go on after a restart."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import TareError
from devices.frames import FrameBatch
from service.estimation.tare.tare import Tare
from service.sessions.estimate_stream import EstimateStream, make_estimate_metadata
from tests.builders.arrays import COUNT_KPA, UNLOADED_KPA
from tests.builders.frames import assert_same_bits
from tests.service.sessions.pieces import Piece, array, cut, frames, hopping, options, run, same


def taken_at(t_ns: int, counts: float) -> Tare:
    """A tare that was taken at `t_ns`, with the baseline so many counts above 500."""
    return Tare(
        baseline_kpa=np.full(2, UNLOADED_KPA + counts * COUNT_KPA),
        baseline_sigma_kpa=np.full(2, 0.001),
        noise_kpa=np.full(2, COUNT_KPA),
        temperature_raw_counts=np.full(2, 480.0),
        t_ns=10**18 + t_ns,
        begin_s=0.0,
        end_s=0.25,
        frames=125,
        source="unloaded",
    )


def baselines(batch: FrameBatch, columns: dict[str, np.ndarray]) -> list[int]:
    """Counts above 500 of the baseline with which each frame was estimated."""
    counts = 500 - batch.pressure_raw.astype(np.float64)
    return [round(c) for c in (counts - columns["gauge_kpa"] / COUNT_KPA)[:, 0].tolist()]


@settings(max_examples=20, deadline=None)
@given(
    instants=st.lists(st.integers(-10, 130), min_size=1, max_size=4).map(sorted),
    between=st.integers(0, 1),
    cuts=st.sets(st.integers(1, 119), max_size=12),
    lag_ms=st.sampled_from([0.0, 10.0, 5000.0]),
)
def test_a_tare_is_in_force_from_the_frame_after_its_instant_whatever_the_pieces(
    instants: list[int], between: int, cuts: Sequence[int], lag_ms: float
) -> None:
    # Instants in frames of 2 ms, exactly at one or a nanosecond before.
    batch = frames(hopping(120, loaded_from=30))
    tares = tuple(
        taken_at(2_000_000 * at - between, 3.0 * number) for number, at in enumerate(instants)
    )
    stream, out, columns = run(cut(batch, cuts), lag_ms=lag_ms, tares=tares)
    assert out.seq.tolist() == list(range(120))
    assert columns["true_grf_n"].tolist() == [1000.0 + i for i in range(120)]
    expected = []
    for t_ns in batch.t_ns:
        in_force = [number for number, tare in enumerate(tares) if tare.t_ns < t_ns]
        expected.append(3 * (in_force[-1] if in_force else 0))  # before all of them, the first
    assert baselines(out, columns) == expected
    assert stream.plan is not None
    assert stream.plan.tare is tares[0]
    _, _, whole = run(cut(batch, []), lag_ms=lag_ms, tares=tares)
    same(columns, whole)


def test_tares_that_were_taken_win_over_a_lead_and_need_no_wait() -> None:
    batch = frames(hopping(300, loaded_from=100), lead=100)
    stream = EstimateStream(array(), options(lag_ms=0.0, tares=(taken_at(0, 7.0),)))
    first, columns = next(stream.estimate_batches(cut(batch, range(1, 300))))
    assert len(first) == 1
    assert baselines(first, columns) == [7]


def test_a_tare_after_the_last_frame_changes_nothing() -> None:
    batch = frames(hopping(120, loaded_from=30))
    one, later = taken_at(0, 0.0), taken_at(2_000_000 * 119, 5.0)
    _, _, columns = run(cut(batch, [50]), tares=(one,))
    _, _, again = run(cut(batch, [50]), tares=(one, later))
    same(columns, again)


def test_all_tares_are_in_the_notes_and_none_if_none_were_taken() -> None:
    tares = (taken_at(0, 0.0), taken_at(10**8, 5.0))
    stream, _, _ = run([(frames(hopping(99, loaded_from=50)), {})], tares=tares)
    assert stream.plan is not None
    notes = json.loads(
        json.dumps(make_estimate_metadata(stream.plan, stream.rounding, tares), allow_nan=False)
    )
    assert [kept["t_ns"] for kept in notes["tares"]] == [tare.t_ns for tare in tares]
    assert notes["tare"] == notes["tares"][0]
    assert "tares" not in make_estimate_metadata(stream.plan, stream.rounding)


def later_part(batch: FrameBatch, after_ns: int) -> FrameBatch:
    """The node was switched on anew: its clock and numbers begin again, UTC goes on."""
    return replace(batch, t_ns=batch.t_ns + after_ns)


@settings(max_examples=20, deadline=None)
@given(
    cuts=st.tuples(
        st.sets(st.integers(1, 59), max_size=8), st.sets(st.integers(1, 89), max_size=8)
    ),
    tared=st.booleans(),
    second_at=st.integers(-10, 200),
    lag_ms=st.sampled_from([0.0, 10.0, 100.0]),
)
def test_a_recording_that_goes_on_after_a_restart_has_one_estimate_a_frame(
    cuts: tuple[set[int], set[int]], tared: bool, second_at: int, lag_ms: float
) -> None:
    first = frames(hopping(60, loaded_from=30), lead=25)
    second = later_part(frames(hopping(90, loaded_from=5, seed=1)), 10**9)
    tares = (taken_at(0, 1.0), taken_at(2_000_000 * second_at + 800_000_000, 4.0)) if tared else ()

    def parts(*where: set[int]) -> list[Piece]:
        return [
            piece
            for part, at in zip((first, second), where, strict=True)
            for piece in cut(part, [*at])
        ]

    stream, out, columns = run(parts(*cuts), lag_ms=lag_ms, tares=tares)
    assert out.seq.tolist() == [*range(60), *range(90)]
    assert out.t_ns.tolist() == [*first.t_ns.tolist(), *second.t_ns.tolist()]
    assert {len(values) for values in columns.values()} == {150}
    assert columns["true_grf_n"].tolist() == [*range(1000, 1060), *range(1000, 1090)]
    _, _, whole = run(parts(set(), set()), lag_ms=lag_ms, tares=tares)
    same(columns, whole)
    assert stream.plan is not None
    if not tared:
        counts = 500 - out.pressure_raw.astype(np.float64)
        gauge = counts - (stream.plan.tare.baseline_kpa - UNLOADED_KPA) / COUNT_KPA
        np.testing.assert_allclose(columns["gauge_kpa"] / COUNT_KPA, gauge, atol=1e-9)


def test_frames_after_a_restart_are_estimated_without_those_before() -> None:
    # The first part ends in contact; the second is estimated as if it were all there is.
    first = frames(np.full((60, 2), 30.0))
    second = later_part(frames(hopping(90, loaded_from=200)), 10**9)
    tares = (taken_at(0, 0.0),)
    _, _, both = run([*cut(first, []), *cut(second, [40])], tares=tares)
    _, _, alone = run(cut(second, []), tares=tares)
    assert both["contact"][59] == 1
    same({name: values[60:] for name, values in both.items()}, alone)


@settings(max_examples=30, deadline=None)
@given(
    cuts=st.sets(st.integers(1, 239), max_size=12),
    handed=st.sets(st.integers(1, 239), max_size=4),
    instants=st.lists(st.integers(-10, 250), max_size=3).map(sorted),
    lag_ms=st.sampled_from([0.0, 10.0, 5000.0]),
)
def test_a_stream_that_continues_from_a_stored_state_gives_the_bits_of_one(
    cuts: set[int], handed: set[int], instants: list[int], lag_ms: float
) -> None:
    first, second = (
        frames(hopping(120, loaded_from=60), lead=60),
        frames(hopping(120, loaded_from=9)),
    )
    batch = FrameBatch.concatenate([first, later_part(second, 10**9)])  # switched on again
    tares = tuple(taken_at(2_000_000 * at, 3.0 * number) for number, at in enumerate(instants))
    _, frames_once, once = run(cut(batch, [120]), lag_ms=lag_ms, tares=tares)
    if not tares:  # a tare is looked for until it is there, whoever asks for less
        handed = {at for at in handed if at > 60}
    stream, found, given = EstimateStream(array(), options(lag_ms=lag_ms, tares=tares)), [], 0
    pieces = cut(batch, sorted(cuts | handed | {120}))  # no batch spans a restart
    for at in [*sorted(handed), 240]:
        rows = given
        some: list[Piece] = []
        while rows < at:
            some.append(pieces.pop(0))
            rows += len(some[-1][0])
        given = rows
        found += list(stream.estimate_batches(some, is_final=at == 240))
        if at != 240:
            kept = through_a_file(stream.state_dict())
            stream = EstimateStream(array(), options(lag_ms=lag_ms, tares=tares))
            stream.load_state(kept)
    joined = FrameBatch.concatenate([batch for batch, _ in found])
    assert_same_bits(joined, frames_once)
    same({name: np.concatenate([c[name] for _, c in found]) for name in found[0][1]}, once)


def through_a_file(kept: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **kept)
    file.seek(0)
    with np.load(file, allow_pickle=False) as read:
        return dict(read)


def test_a_stream_without_frames_has_no_state() -> None:
    with pytest.raises(TareError, match="no frames"):
        EstimateStream(array(), options()).state_dict()
