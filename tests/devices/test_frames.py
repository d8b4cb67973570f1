"""Frames as columns, their flags, and what travels with them."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from devices.frames import (
    FRAME_COLUMNS,
    NO_SERVO_AGE,
    NO_SERVO_COUNTS,
    NOT_READ,
    ArrayInfo,
    FrameBatch,
)
from tests.builders.arrays import NEWTON_CHIP, UTC_NS, make_array, make_servo

# docs/formats.md, table of the columns
DESIGN = {
    "seq": ("uint64", False),
    "t_mono_ns": ("int64", False),
    "t_ns": ("int64", False),
    "pressure_raw": ("uint16", True),
    "temperature_raw": ("uint16", True),
    "sample_offset_us": ("int32", True),
    "servo_counts": ("int32", False),
    "servo_age_us": ("int32", False),
    "tile_flags": ("uint8", True),
    "frame_flags": ("uint8", False),
    "reference_force_n": ("float32", False),
}


def batch(n: int = 3, tiles: int = 2, first: int = 0) -> FrameBatch:
    """Return a batch in which every cell differs from its neighbours."""
    columns = {
        name: np.arange(first, first + n * (tiles if per_tile else 1))
        .reshape((n, tiles) if per_tile else (n,))
        .astype(dtype)
        for name, (dtype, per_tile) in DESIGN.items()
    }
    return FrameBatch(**columns)


def test_columns_and_marks_are_those_of_the_design() -> None:
    assert [f.name for f in fields(FrameBatch)] == list(DESIGN)
    found = {name: (np.dtype(t).name, per_tile) for name, (t, per_tile) in FRAME_COLUMNS.items()}
    assert found == DESIGN
    assert (NOT_READ, NO_SERVO_COUNTS, NO_SERVO_AGE) == (65535, -2147483648, -1)


@pytest.mark.parametrize(("name", "per_tile"), [(n, is_2d) for n, (_, is_2d) in DESIGN.items()])
def test_a_column_of_another_type_or_shape_is_refused_by_name(name: str, per_tile: bool) -> None:
    good = batch()
    column = getattr(good, name)
    wrong = [column.astype(np.complex128)]
    if name != "pressure_raw":  # which has the shape that the others must have
        wrong += [column[:-1], *([getattr(batch(tiles=3), name)] if per_tile else [])]
    for values in wrong:
        with pytest.raises(ValueError, match=rf"FrameBatch\.{name}:"):
            replace(good, **{name: values})


@given(sizes=st.lists(st.integers(0, 5), min_size=1, max_size=6), tiles=st.integers(1, 4))
def test_rows_and_concatenation_undo_each_other(sizes: list[int], tiles: int) -> None:
    whole = batch(n=sum(sizes), tiles=tiles)
    ends = np.cumsum(sizes).tolist()
    pieces = [whole.slice_rows(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    assert [(len(piece), piece.tile_count) for piece in pieces] == [(n, tiles) for n in sizes]
    for end, size, piece in zip(ends, sizes, pieces, strict=True):
        np.testing.assert_array_equal(piece.seq, whole.seq[end - size : end])
    again = FrameBatch.concatenate(pieces)
    for name in DESIGN:
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))
        assert getattr(again, name).dtype == getattr(whole, name).dtype


def test_rows_copy_nothing() -> None:
    whole = batch()
    part = whole.slice_rows(1, 3)
    for name in DESIGN:
        assert np.shares_memory(getattr(part, name), getattr(whole, name))


def test_batches_of_different_arrays_and_no_batches_do_not_join() -> None:
    with pytest.raises(ValueError, match="dimension"):
        FrameBatch.concatenate([batch(tiles=2), batch(tiles=3)])
    with pytest.raises(ValueError, match="at least one"):
        FrameBatch.concatenate([])


def test_array_info_travels_as_json_without_loss() -> None:
    # Nothing in it is a default.
    servo = make_servo(sign=-1, ratio=0.1, ankle_travel_m_per_rad=None)
    info = make_array(servo=servo, nominal_rate_hz=394.87, stream_id="00ff")
    assert ArrayInfo.model_validate_json(info.model_dump_json()) == info
    plain = json.loads(info.model_dump_json())
    assert plain["utc_offset_ns"] == UTC_NS
    assert plain["tiles"][0]["registers"] == list(NEWTON_CHIP)
    assert plain["servo"]["ankle_travel_m_per_rad"] is None
    assert info.serials == ("T01", "T02")


def test_array_info_of_a_newer_version_is_refused_rather_than_half_read_or_changed() -> None:
    with pytest.raises(ValidationError, match="phase_of_the_moon"):
        make_array(phase_of_the_moon=1)
    with pytest.raises(ValidationError, match="frozen"):
        make_array().node = "other"
