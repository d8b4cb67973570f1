"""Bins of frames at each zoom, exact in any pieces, bounded in a preview; and their file."""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import storage.sessions.overview
from devices.errors import DamagedFileError
from devices.frames import NOT_READ
from storage.durable_files import open_regular_file
from storage.schema import Array
from storage.sessions.overview import OverviewReader, encode_overview, open_overview, write_overview
from storage.sessions.pyramid import (
    BINS_PER_COARSER_BIN,
    CONTACT_ABSENT,
    CONTACT_PRESENT,
    CONTACT_UNCERTAIN,
    FRAMES_PER_FINEST_BIN,
    MAX_COARSEST_BINS,
    BinBuilder,
    Bins,
    bin_column_types,
    bin_source_columns,
    build_levels,
    choose_frames_in_bin,
    make_single_frame_bins,
    merge_bins_within_parts,
    select_and_downsample_bins,
)

TILES = 2


def frames(n: int, seed: int = 0, parts: Sequence[int] = ()) -> dict[str, Any]:
    """Estimated frames with holes, faults and what is not known, in one part or several."""
    rng = np.random.default_rng(seed)
    grf_n = rng.normal(20.0, 10.0, n).astype(np.float32)
    grf_n[rng.random(n) < 0.1] = np.nan
    some: dict[str, Any] = {
        "seq": np.cumsum(rng.choice([1, 1, 1, 5], n)).astype(np.uint64),
        "t_ns": 10**18 + np.cumsum(rng.integers(1, 3_000_000, n)),
        "tile_flags": rng.choice([0, 0, 1, 4], (n, TILES)).astype(np.uint8),
        "frame_flags": rng.choice([0, 0, 8], n).astype(np.uint8),
        "grf_n": grf_n,
        "contact": rng.choice([0, 1, 255], n).astype(np.uint8),
        "estimate_flags": (2 ** rng.integers(0, 14, n)).astype(np.uint16),
        "force_n": rng.normal(5.0, 3.0, (n, TILES)).astype(np.float32),
    }
    floats = ("grf_sigma_n", "grf_lower_bound_n", "cop_x_m", "cop_y_m", "angle_rad")
    for name in (*floats, "cop_sigma_x_m", "cop_sigma_y_m"):
        some[name] = rng.random(n).astype(np.float32)
    if parts:
        some["part"] = np.repeat(np.arange(len(parts), dtype=np.uint16), parts)
        for number in range(len(parts)):
            of = some["part"] == number
            some["seq"][of] -= some["seq"][of][0]  # a stream begins again
    return some


def rows(columns: Mapping[str, Any], begin: int, end: int) -> dict[str, Any]:
    return {name: values[begin:end] for name, values in columns.items()}


def gathered(columns: Mapping[str, Any], cuts: Sequence[int] = ()) -> BinBuilder:
    pyramid = BinBuilder(FRAMES_PER_FINEST_BIN)
    edges = [0, *sorted(cuts), len(columns["seq"])]
    for begin, end in itertools.pairwise(edges):
        pyramid.add_frames(rows(columns, begin, end))
    return pyramid


def same(one: Bins, other: Bins) -> None:
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


@settings(max_examples=60)
@given(
    parts=st.lists(st.integers(1, 200), min_size=1, max_size=4),
    cuts=st.sets(st.integers(0, 300)),
    seed=st.integers(0, 9),
)
def test_bins_of_any_pieces_are_those_computed_one_by_one(
    parts: list[int], cuts: set[int], seed: int
) -> None:
    n = sum(parts)
    columns = frames(n, seed, parts)
    found = gathered(columns, [cut for cut in cuts if cut < n]).get_bins()
    assert found is not None
    assert set(found) == set(bin_column_types(TILES, has_estimates=True))
    at = 0
    for number, length in enumerate(parts):
        first = sum(parts[:number])
        for begin in range(first, first + length, FRAMES_PER_FINEST_BIN):
            end = min(begin + FRAMES_PER_FINEST_BIN, first + length)
            some = rows(columns, begin, end)
            before = columns["seq"][begin - 1] if begin > first else None
            check(found, at, some, before, number)
            at += 1
    assert at == len(found["part"])


def check(found: Bins, at: int, some: dict[str, Any], before: Any, part: int) -> None:
    """One bin against the plainest way to work it out."""
    seq = [*([int(before)] if before is not None else []), *some["seq"].tolist()]
    half_n = np.float32(1.96) * some["grf_sigma_n"]
    with np.errstate(all="ignore"):
        expected = {
            "t_first_ns": some["t_ns"][0],
            "t_last_ns": some["t_ns"][-1],
            "part": part,
            "frames": len(some["seq"]),
            "missing": sum(b - a - 1 for a, b in itertools.pairwise(seq)),
            "grf_n_min": np.fmin.reduce(some["grf_n"]),
            "grf_n_max": np.fmax.reduce(some["grf_n"]),
            "grf_n_max_t_ns": some["t_ns"][
                0 if np.isnan(some["grf_n"]).all() else np.nanargmax(some["grf_n"])
            ],
            "grf_low_n_min": np.fmin.reduce(some["grf_n"] - half_n),
            "grf_high_n_max": np.fmax.reduce(some["grf_n"] + half_n),
            "grf_unknown": np.isnan(some["grf_n"]).sum(),
            "force_n_1_max": some["force_n"][:, 1].max(),
            "cop_x_m_min": some["cop_x_m"].min(),
            "cop_x_low_m_min": (some["cop_x_m"] - np.float32(1.96) * some["cop_sigma_x_m"]).min(),
            "cop_y_high_m_max": (some["cop_y_m"] + np.float32(1.96) * some["cop_sigma_y_m"]).max(),
            "estimate_flags": np.bitwise_or.reduce(some["estimate_flags"]),
            "tile_flags_0": np.bitwise_or.reduce(some["tile_flags"][:, 0]),
            "contact": sum(
                bit
                for bit, value in (
                    (CONTACT_ABSENT, 0),
                    (CONTACT_PRESENT, 1),
                    (CONTACT_UNCERTAIN, 255),
                )
                if (some["contact"] == value).any()
            ),
        }
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name][at], value, err_msg=name)


def test_each_level_has_the_extremes_of_the_frames() -> None:
    columns = frames(
        FRAMES_PER_FINEST_BIN * MAX_COARSEST_BINS * 3,
        parts=(
            FRAMES_PER_FINEST_BIN * MAX_COARSEST_BINS * 2 + 7,
            FRAMES_PER_FINEST_BIN * MAX_COARSEST_BINS - 7,
        ),
    )
    finest = gathered(columns).get_bins()
    assert finest is not None
    levels = build_levels(finest)
    assert [len(level["part"]) for level in levels[1:]] == [
        -(-(2 * MAX_COARSEST_BINS + 1) // BINS_PER_COARSER_BIN)
        + MAX_COARSEST_BINS // BINS_PER_COARSER_BIN
    ]
    for level in levels:
        assert level["frames"].sum() == len(columns["seq"])
        assert np.nanmax(level["grf_n_max"]) == np.nanmax(columns["grf_n"])
        assert level["missing"].sum() == finest["missing"].sum()
    same(levels[1], merge_bins_within_parts(finest, BINS_PER_COARSER_BIN))


def test_levels_end_where_parts_have_one_bin_each() -> None:
    columns = frames(MAX_COARSEST_BINS + 10, parts=(1,) * (MAX_COARSEST_BINS + 10))
    finest = gathered(columns).get_bins()
    assert finest is not None
    assert [len(level["part"]) for level in build_levels(finest)] == [MAX_COARSEST_BINS + 10]


def test_unread_counts_are_no_extremes() -> None:
    n = 100
    columns = {
        name: values
        for name, values in frames(n).items()
        if name in bin_source_columns(has_estimates=False)
    }
    columns["pressure_raw"] = np.tile(np.array([500, 400], dtype=np.uint16), (n, 1))
    columns["pressure_raw"][3:5, 0] = NOT_READ, 510
    columns["pressure_raw"][FRAMES_PER_FINEST_BIN:, 1] = NOT_READ
    found = gathered(columns).get_bins()
    assert found is not None
    assert set(found) == set(bin_column_types(TILES, has_estimates=False))
    assert found["pressure_raw_0_min"].tolist() == [500, 500]
    assert found["pressure_raw_0_max"].tolist() == [510, 500]
    assert found["pressure_raw_1_max"][0] == 400
    assert np.isnan(found["pressure_raw_1_max"][1])


def test_without_a_frame_there_is_nothing() -> None:
    pyramid = BinBuilder(FRAMES_PER_FINEST_BIN)
    pyramid.add_frames(rows(frames(10), 0, 0))
    assert pyramid.get_bins() is None
    assert pyramid.pop_levels() == []


@pytest.mark.parametrize("estimated", [True, False])
def test_every_column_of_a_bin_has_its_type(estimated: bool) -> None:
    columns = dict(frames(200))
    if not estimated:
        columns = {n: columns[n] for n in bin_source_columns(has_estimates=False) if n in columns}
        columns["pressure_raw"] = np.full((200, TILES), 500, dtype=np.uint16)
    found = gathered(columns).get_bins()
    assert found is not None
    for name, type_ in bin_column_types(TILES, has_estimates=estimated).items():
        assert np.can_cast(found[name].dtype, type_, casting="same_kind"), name


# --- preview --------------------------------------------------------------------------------------


def raw_frames(first: int, n: int, part: int = 0) -> dict[str, Array]:
    """Raw raw_frames of two tiles, a peak in one of them every 997 raw_frames."""
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


@pytest.mark.parametrize("pieces", [(1500,), (64, 3, 7)])
def test_a_longer_preview_is_coarser_and_keeps_extremes(pieces: tuple[int, ...]) -> None:
    so_far = BinBuilder(max_bins=500)
    at, i, sizes = 0, 0, set()
    while at < 12_000:
        n = pieces[i % len(pieces)]
        so_far.add_frames(raw_frames(at, n))
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
    whole = make_single_frame_bins(raw_frames(0, at))
    for tile in (0, 1):
        assert bins[f"pressure_raw_{tile}_min"].min() == whole[f"pressure_raw_{tile}_min"].min()
        assert bins[f"pressure_raw_{tile}_max"].max() == whole[f"pressure_raw_{tile}_max"].max()
    for row in range(len(bins["part"])):
        begin, end = (int(bins[f"t_{which}_ns"][row]) // 2_000_000 for which in ("first", "last"))
        assert bins["frames"][row] == end - begin + 1
        assert (bins["pressure_raw_1_min"][row] == 300) == any(
            s % 997 == 0 for s in range(begin, end + 1)
        )


def test_preview_bins_end_with_their_part_and_count_lost_frames() -> None:
    so_far = BinBuilder(max_bins=100)
    so_far.add_frames(raw_frames(0, 1030))
    so_far.add_frames(raw_frames(1040, 1030))
    so_far.add_frames(raw_frames(0, 2000, part=1))
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
def test_bins_of_a_time_are_merged_until_few_enough(
    begin_ns: int | None, end_ns: int | None, most: int, expected: tuple[int, int]
) -> None:
    bins: Any = make_single_frame_bins(raw_frames(0, 1000))
    found, count = select_and_downsample_bins(bins, begin_ns, end_ns, most)
    assert (len(found["part"]), count) == expected


HASH = "0123456789abcdef" * 4


def content(n: int, parts: tuple[int, ...] = ()) -> tuple[list[Bins], pa.Buffer]:
    levels = gathered(frames(n, parts=parts)).pop_levels()
    return levels, encode_overview(levels, tile_count=TILES, frames_sha256=HASH)


def test_every_level_is_read_as_it_was_written(tmp_path: Path) -> None:
    levels, written = content(100_000)
    write_overview(tmp_path / "overview.arrow", levels, tile_count=TILES, frames_sha256=HASH)
    assert (tmp_path / "overview.arrow").read_bytes() == written.to_pybytes()
    with open_overview(tmp_path / "overview.arrow") as overview:
        assert overview.index.frames_sha256 == HASH
        assert overview.index.level_count == len(levels) == 2
        assert overview.index.begin_ns == levels[0]["t_first_ns"][0]
        for number, level in enumerate(levels):
            found = overview.read_bins(number, None, None)
            same({name: level[name].astype(found[name].dtype) for name in found}, found)
            assert overview.estimate_bin_count(number, None, None) == len(level["part"])


def test_arrow_reads_without_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # It would abort a process that ends meanwhile.
    levels, _ = content(1000)
    write_overview(tmp_path / "overview.arrow", levels, tile_count=TILES, frames_sha256=HASH)
    opened: list[io.BufferedReader] = []

    def kept(path: Path) -> io.BufferedReader:
        opened.append(open_regular_file(path))
        return opened[-1]

    monkeypatch.setattr(storage.sessions.overview, "open_regular_file", kept)
    with open_overview(tmp_path / "overview.arrow") as overview:
        assert [file.closed for file in opened] == [True]
        assert len(overview.read_bins(0, None, None)["part"]) == len(levels[0]["part"])


def test_some_time_is_all_bins_that_have_a_frame_in_it(tmp_path: Path) -> None:
    levels, written = content(600_000)
    with OverviewReader(pa.BufferReader(written), where="here") as overview:
        finest = levels[0]
        begin_ns, end_ns = int(finest["t_last_ns"][5000]), int(finest["t_first_ns"][6000])
        found = overview.read_bins(0, begin_ns, end_ns)
        assert found["t_first_ns"][0] == finest["t_first_ns"][5000]
        assert found["t_last_ns"][-1] == finest["t_last_ns"][5999]
        assert (
            overview.estimate_bin_count(0, begin_ns, end_ns) == 4096
        )  # of three pieces one is looked at
        nothing = overview.read_bins(0, end_ns + 10**15, None)
        assert len(nothing["part"]) == 0
        assert nothing.keys() == found.keys()


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 10**7), bit=st.integers(0, 7))
def test_any_flipped_bit_is_damage_or_changes_nothing(tmp_path: Path, at: int, bit: int) -> None:
    levels, written = content(3000)
    changed = bytearray(written)
    changed[at % len(changed)] ^= 1 << bit
    (tmp_path / "overview.arrow").write_bytes(changed)
    try:
        with open_overview(tmp_path / "overview.arrow") as overview:
            assert overview.index.frames_sha256 == HASH
            found = overview.read_bins(0, None, None)
    except DamagedFileError:
        return
    same({name: levels[0][name].astype(found[name].dtype) for name in found}, found)


@given(length=st.integers(0, 10**7))
def test_a_file_that_ends_too_early_is_damage(length: int) -> None:
    _, written = content(300)
    some = written.slice(0, length % len(written))
    with pytest.raises(DamagedFileError, match="Delete it"):
        OverviewReader(pa.BufferReader(some), where="here")


def test_another_file_is_refused_and_none_is_none(tmp_path: Path) -> None:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, pa.schema([("part", pa.int64())])):
        pass
    with pytest.raises(DamagedFileError, match="is no overview"):
        OverviewReader(pa.BufferReader(sink.getvalue()), where="here")
    with pytest.raises(FileNotFoundError):
        open_overview(tmp_path / "overview.arrow")


@pytest.mark.parametrize(
    ("frame_count", "min_bins", "size"), [(100, 0, 64), (100, 7, 4), (0, 0, 1)]
)
def test_bins_are_as_large_as_their_number_allows(
    frame_count: int, min_bins: int, size: int
) -> None:
    assert choose_frames_in_bin(frame_count, min_bins) == size
