"""What a slice holds: the rows and columns that were asked for, and no others."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import UsageError
from storage.formats.export import make_one_pass_frame_source
from storage.formats.slice import Slice
from storage.schema import MEASURED_COLUMNS
from tests.builders.arrays import make_array
from tests.storage.formats.exports import (
    ROWS,
    TABLES,
    cut,
    export,
    exported,
    extra,
    frames,
    names,
    read,
)

# --- rows -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("start_s", "end_s", "first", "last"),
    [
        (0.0, 0.02, 0, 9),
        (0.02, 0.04, 10, 19),  # what ends where another begins shares no frame with it
        (0.021, 0.0399, 11, 19),
        (None, 0.002, 0, 0),
        (0.098, None, 49, 49),
        (0.0, 1e9, 0, 49),
    ],
)
def test_a_slice_begins_with_its_start_and_ends_before_its_end(
    start_s: float | None, end_s: float | None, first: int, last: int
) -> None:
    table = read(exported("arrow", Slice(start_s, end_s, ("seq",))), "arrow")
    assert table.column("seq").to_pylist() == [2**60 + i for i in range(first, last + 1)]


@pytest.mark.parametrize("to", TABLES)
@pytest.mark.parametrize("every", [20, ROWS])
def test_a_slice_between_two_frames_still_has_a_header(to: str, every: int) -> None:
    part = Slice(0.051, 0.0515, ("t_ns", "force_n"))
    table = read(exported(to, part, every=every), to)
    assert table.num_rows == 0
    assert table.column_names == ["t_ns", "force_n_0", "force_n_1"]


def test_seconds_count_from_the_first_frame_whatever_the_pieces_are() -> None:
    part = Slice(0.03, 0.07, ("seq",))
    assert len({exported("csv", part, every=every) for every in (1, 13, ROWS)}) == 1


def test_only_a_slice_of_everything_is_all() -> None:
    assert Slice().is_unrestricted
    assert not Slice(start_s=0.0).is_unrestricted
    assert not Slice(columns=("seq",)).is_unrestricted


# --- columns --------------------------------------------------------------------------------------


@pytest.mark.parametrize("to", TABLES)
@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        (("grf_n",), "grf_n"),
        (("force_n",), "force_n_0 force_n_1"),
        (("force_n_1",), "force_n_1"),
        (("t_ns", "seq"), "t_ns seq"),
        (("force_n_1", "seq", "force_n_0"), "force_n_1 seq force_n_0"),
        (("force_n_1", "grf_n", "force_n"), "force_n_1 grf_n force_n_0"),
        (("grf_n", "grf_n", "seq", "grf_n"), "grf_n seq"),
        (("phase", "pressure_raw", "phase"), "phase pressure_raw_0 pressure_raw_1"),
    ],
)
def test_columns_are_asked_for_by_tile_or_for_all_tiles_and_keep_their_order(
    to: str, asked: tuple[str, ...], expected: str
) -> None:
    assert names(Slice(columns=asked), to) == expected.split()


@pytest.mark.parametrize(
    "unknown", ["magic", "force_n_2", "force_n_", "FORCE_N", "", "true_grf_n", "x" * 10_000, "a\0"]
)
@pytest.mark.parametrize("to", TABLES)
def test_a_column_that_is_not_there_is_refused_before_the_first_chunk(
    to: str, unknown: str
) -> None:
    chunks = export(
        make_one_pass_frame_source(cut(frames(), extra(), 20)),
        make_array(),
        {},
        to,
        Slice(columns=("seq", unknown)),
    )
    with pytest.raises(UsageError, match="no column") as caught:
        next(chunks)
    assert len(str(caught.value)) < 1000
    assert "force_n" in caught.value.expected


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.sampled_from([f for c in MEASURED_COLUMNS for f in c.flat_names(2)]), min_size=1)
)
def test_any_choice_of_columns_is_that_choice_without_repetitions(asked: Sequence[str]) -> None:
    assert names(Slice(columns=tuple(asked))) == list(dict.fromkeys(asked))
