"""Bins of a session that goes on: bounded, and without a peak that hides."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from storage.schema import Array
from storage.sessions.pyramid import PreviewBins, make_single_frame_bins, select_and_downsample_bins


def frames(first: int, n: int, part: int = 0) -> dict[str, Array]:
    """Raw frames of two tiles, a peak in one of them every 997 frames."""
    seq = np.arange(first, first + n, dtype=np.uint64)
    pressure_raw = np.stack([500 - seq % 7, np.where(seq % 997 == 0, 300, 500)], axis=1)
    return {
        "seq": seq,
        "t_ns": seq.astype(np.int64) * 2_000_000 + part * 10**12,
        "tile_flags": np.zeros((n, 2), np.uint8),
        "frame_flags": np.zeros(n, np.uint8),
        "pressure_raw": pressure_raw.astype(np.uint16),
        "part": np.full(n, part, np.uint16),
    }


@pytest.mark.parametrize("pieces", [(1,), (10,), (1500,), (64, 3, 700)])
def test_the_longer_it_is_the_coarser_and_nothing_hides(pieces: tuple[int, ...]) -> None:
    so_far = PreviewBins(max_bins=500)
    at, i, sizes = 0, 0, set()
    while at < 12_000:
        n = pieces[i % len(pieces)]
        so_far.add_frames(frames(at, n))
        at, i = at + n, i + 1
        sizes.add(so_far.frames_in_bin)
    bins = so_far.get_bins()
    assert bins is not None
    assert sizes >= {4, 16, 64}
    # At most so many, and what was not merged yet.
    assert len(bins["part"]) <= 500 + 1024 // 64 + 1
    assert so_far.frame_count == bins["frames"].sum() == at
    assert bins["t_first_ns"][0] == 0
    assert bins["t_last_ns"][-1] == (at - 1) * 2_000_000
    whole = make_single_frame_bins(frames(0, at))
    for tile in (0, 1):
        assert bins[f"pressure_raw_{tile}_min"].min() == whole[f"pressure_raw_{tile}_min"].min()
        assert bins[f"pressure_raw_{tile}_max"].max() == whole[f"pressure_raw_{tile}_max"].max()
    for row in range(len(bins["part"])):
        begin, end = (int(bins[f"t_{which}_ns"][row]) // 2_000_000 for which in ("first", "last"))
        assert bins["frames"][row] == end - begin + 1
        assert (bins["pressure_raw_1_min"][row] == 300) == any(
            s % 997 == 0 for s in range(begin, end + 1)
        )


def test_no_bin_reaches_over_into_another_part_and_what_is_lost_is_counted() -> None:
    so_far = PreviewBins(max_bins=100)
    so_far.add_frames(frames(0, 1030))
    so_far.add_frames(frames(1040, 1030))
    so_far.add_frames(frames(0, 2000, part=1))
    bins = so_far.get_bins()
    assert bins is not None
    assert bins["missing"].sum() == 10
    assert bins["frames"][bins["part"] == 0].sum() == 2060
    assert bins["frames"][bins["part"] == 1].sum() == 2000
    assert (np.diff(bins["t_first_ns"]) > 0).all()


@pytest.mark.parametrize(
    ("begin_ns", "end_ns", "most", "expected"),
    [
        (None, None, 1000, (1000, 1)),
        (None, None, 999, (250, 4)),
        (400_000_000, None, 900, (800, 1)),
    ],
)
def test_some_time_of_it_is_merged_until_it_is_as_few_as_asked_for(
    begin_ns: int | None, end_ns: int | None, most: int, expected: tuple[int, int]
) -> None:
    bins: Any = make_single_frame_bins(frames(0, 1000))
    found, count = select_and_downsample_bins(bins, begin_ns, end_ns, most)
    assert (len(found["part"]), count) == expected
