"""The temperature of frames that did not read it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.flags import TileFlag
from devices.frames import NOT_READ, FrameBatch
from devices.temperature_hold import HeldTemperature, hold_temperature
from tests.builders.frames import make_frames

MS = 1_000_000


def frames(
    temperature_raw: list[list[int]],
    t_ms: list[int] | None = None,
    tile_flags: list[list[int]] | None = None,
) -> FrameBatch:
    n, tiles = len(temperature_raw), len(temperature_raw[0])
    t_mono_ns = np.array(t_ms if t_ms is not None else range(n)) * MS
    return make_frames(
        n, tiles, temperature_raw=temperature_raw, t_mono_ns=t_mono_ns, tile_flags=tile_flags or 0
    )


def held(batch: FrameBatch, before: HeldTemperature | None = None) -> list[list[int]]:
    result: list[list[int]] = hold_temperature(batch, before)[0].temperature_raw.tolist()
    return result


N = NOT_READ


def test_a_frame_without_temperature_has_that_of_the_frame_before() -> None:
    assert held(frames([[500], [N], [N], [503], [N]])) == [[500], [500], [500], [503], [503]]


def test_each_tile_has_its_own() -> None:
    assert held(frames([[500, N], [N, 600], [N, N]])) == [[500, N], [500, 600], [500, 600]]


def test_nothing_is_held_from_a_later_frame() -> None:
    assert held(frames([[N], [N], [500]])) == [[N], [N], [500]]


def test_what_was_read_is_never_changed() -> None:
    batch = frames([[500], [510], [490]])
    assert hold_temperature(batch)[0] is batch, "nothing to do, nothing copied"


def test_the_last_of_temperatures_that_were_all_read_is_held_and_is_no_part_of_the_frames() -> None:
    batch = frames([[500, 600], [510, 601]], [7, 9])
    last = hold_temperature(batch)[1]
    assert last.temperature_raw.tolist() == [510, 601]
    assert last.t_mono_ns.tolist() == [9 * MS, 9 * MS]
    assert (last.temperature_raw.dtype.name, last.t_mono_ns.dtype.name) == ("uint16", "int64")
    assert not np.shares_memory(last.temperature_raw, batch.temperature_raw)
    assert held(frames([[N, N]], [10]), last) == [[510, 601]]


def test_the_frames_themselves_keep_what_was_read() -> None:
    batch = frames([[500], [N]])
    hold_temperature(batch)
    assert batch.temperature_raw.tolist() == [[500], [N]]


@pytest.mark.parametrize(("age_ms", "known"), [(1, True), (1000, True), (1001, False)])
def test_a_temperature_is_held_for_a_second(age_ms: int, known: bool) -> None:
    assert held(frames([[500], [N]], [0, age_ms])) == [[500], [500 if known else N]]


def test_being_held_does_not_make_it_any_younger() -> None:
    assert held(frames([[500], [N], [N]], [0, 700, 1400])) == [[500], [500], [N]]


@pytest.mark.parametrize("bit", [s for s in TileFlag if s & TileFlag.UNUSABLE])
def test_an_unusable_reading_is_not_held(bit: TileFlag) -> None:
    batch = frames([[500], [1023], [N]], tile_flags=[[0], [int(bit)], [0]])
    assert held(batch) == [[500], [1023], [500]]


@pytest.mark.parametrize("bit", [TileFlag.RETRIED, TileFlag.OVER_RANGE])
def test_a_usable_reading_is_held_whatever_else_is_said_of_it(bit: TileFlag) -> None:
    batch = frames([[500], [505], [N]], tile_flags=[[0], [int(bit)], [0]])
    assert held(batch) == [[500], [505], [505]]


def test_no_temperature_has_come_before_the_first_frame() -> None:
    _, last = hold_temperature(frames([[N, 500], [N, N]]))
    assert last.temperature_raw.tolist() == [N, 500]
    assert last.t_mono_ns.tolist() == [0, 0]


streams = st.integers(1, 30).flatmap(
    lambda n: st.tuples(
        st.lists(
            st.lists(st.sampled_from([N, N, N, 480, 500, 520]), min_size=2, max_size=2),
            min_size=n,
            max_size=n,
        ),
        st.lists(st.integers(1, 700), min_size=n, max_size=n),
        st.lists(
            st.lists(st.sampled_from([0, 0, 0, 1, 4, 8]), min_size=2, max_size=2),
            min_size=n,
            max_size=n,
        ),
        st.lists(st.booleans(), min_size=n, max_size=n),
    )
)


@settings(max_examples=200)
@given(stream=streams)
def test_any_split_of_a_stream_gives_the_same(
    stream: tuple[list[list[int]], list[int], list[list[int]], list[bool]],
) -> None:
    temperature_raw, gaps_ms, status, cuts = stream
    batch = frames(temperature_raw, np.cumsum(gaps_ms).tolist(), status)
    whole, last = hold_temperature(batch)
    ends = [row for row, cut in enumerate(cuts) if cut and row] + [len(batch)]
    pieces, before, begin = [], None, 0
    for end in ends:
        piece, before = hold_temperature(batch.slice_rows(begin, end), before)
        pieces.append(piece)
        begin = end
    assert (
        np.concatenate([piece.temperature_raw for piece in pieces]).tolist()
        == whole.temperature_raw.tolist()
    )
    assert before is not None
    np.testing.assert_array_equal(before.temperature_raw, last.temperature_raw)
    np.testing.assert_array_equal(before.t_mono_ns, last.t_mono_ns)


@settings(max_examples=200)
@given(stream=streams)
def test_what_is_held_is_the_last_usable_one_of_the_last_second(
    stream: tuple[list[list[int]], list[int], list[list[int]], list[bool]],
) -> None:
    temperature_raw, gaps_ms, status, _ = stream
    t_ms = np.cumsum(gaps_ms).tolist()
    expected = [list(row) for row in temperature_raw]
    for tile in range(2):
        for row in range(len(temperature_raw)):
            if temperature_raw[row][tile] != N:
                continue
            usable = [
                r
                for r in range(row)
                if temperature_raw[r][tile] != N and not status[r][tile] & TileFlag.UNUSABLE
            ]
            if usable and t_ms[row] - t_ms[usable[-1]] <= 1000:
                expected[row][tile] = temperature_raw[usable[-1]][tile]
    assert held(frames(temperature_raw, t_ms, status)) == expected
