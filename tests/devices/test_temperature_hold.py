"""The temperature of frames that did not read it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.flags import TileFlag
from devices.frames import NOT_READ, FrameBatch, hold_temperature
from tests.builders.frames import make_frames

MS = 1_000_000
N = NOT_READ


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


def test_frames_that_read_every_temperature_are_not_copied() -> None:
    batch = frames([[500], [510], [490]])
    assert hold_temperature(batch)[0] is batch


def test_the_last_temperatures_are_held_for_the_next_frames_and_share_no_memory_with_these() -> (
    None
):
    batch = frames([[500, 600], [510, 601]], [7, 9])
    _, last = hold_temperature(batch)
    assert last.temperature_raw.tolist() == [510, 601]
    assert last.t_mono_ns.tolist() == [9 * MS, 9 * MS]
    assert (last.temperature_raw.dtype.name, last.t_mono_ns.dtype.name) == ("uint16", "int64")
    assert not np.shares_memory(last.temperature_raw, batch.temperature_raw)
    following, _ = hold_temperature(frames([[N, N]], [10]), last)
    assert following.temperature_raw.tolist() == [[510, 601]]


def test_a_tile_that_never_read_a_temperature_has_none_to_hold() -> None:
    _, last = hold_temperature(frames([[N, 500], [N, N]]))
    assert last.temperature_raw.tolist() == [N, 500]
    assert last.t_mono_ns.tolist() == [0, 0]


@pytest.mark.parametrize(
    ("t_ms", "expected"),
    [
        ([0, 1, 1000], [500, 500, 500]),
        ([0, 1, 1001], [500, 500, N]),
        ([0, 700, 1400], [500, 500, N]),
    ],
)
def test_a_temperature_is_held_for_a_second_since_it_was_read(
    t_ms: list[int], expected: list[int]
) -> None:
    batch = frames([[500], [N], [N]], t_ms)
    assert hold_temperature(batch)[0].temperature_raw[:, 0].tolist() == expected
    assert batch.temperature_raw[:, 0].tolist() == [500, N, N], "the frames keep what they read"


def pairs(values: list[int], rows: int) -> st.SearchStrategy[list[list[int]]]:
    pair = st.lists(st.sampled_from(values), min_size=2, max_size=2)
    return st.lists(pair, min_size=rows, max_size=rows)


@settings(max_examples=100)
@given(data=st.data(), rows=st.integers(1, 30))
def test_the_last_usable_temperature_of_the_last_second_is_held_in_any_split_of_a_stream(
    data: st.DataObject, rows: int
) -> None:
    temperature_raw = data.draw(pairs([N, N, N, 480, 500, 520], rows))
    t_ms = np.cumsum(data.draw(st.lists(st.integers(1, 700), min_size=rows, max_size=rows)))
    flags = data.draw(pairs([0, 0, 0, 1, 2, 4, 8, 16, 32], rows))
    batch = frames(temperature_raw, t_ms.tolist(), flags)
    whole, last = hold_temperature(batch)

    expected = [list(row) for row in temperature_raw]
    for tile in range(2):
        usable: int | None = None
        for row in range(rows):
            if temperature_raw[row][tile] != N:
                usable = usable if flags[row][tile] & TileFlag.UNUSABLE else row
            elif usable is not None and t_ms[row] - t_ms[usable] <= 1000:
                expected[row][tile] = temperature_raw[usable][tile]
    assert whole.temperature_raw.tolist() == expected

    pieces, before, begin = [], None, 0
    for end in sorted(data.draw(st.sets(st.integers(1, rows))) | {rows}):
        piece, before = hold_temperature(batch.slice_rows(begin, end), before)
        pieces += piece.temperature_raw.tolist()
        begin = end
    assert pieces == expected
    assert before is not None
    np.testing.assert_array_equal(before.temperature_raw, last.temperature_raw)
    np.testing.assert_array_equal(before.t_mono_ns, last.t_mono_ns)
