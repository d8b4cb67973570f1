"""Frames that were never taken: what a test says of a column, and the ordinary in all others."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.flags import TileFlag
from devices.frames import FRAME_COLUMNS, NO_SERVO_AGE, NO_SERVO_COUNTS, NOT_READ, FrameBatch
from tests.builders.arrays import PERIOD_NS, UNLOADED_COUNTS, UTC_NS


def _read_only(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    values = values.copy()
    values.flags.writeable = False
    return values


def _at_an_odd_address(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """As in a message that was cut out of another."""
    return np.frombuffer(b"x" + values.tobytes(), values.dtype, offset=1).reshape(values.shape)


LAYOUTS: dict[str, Callable[[npt.NDArray[Any]], npt.NDArray[Any]]] = {
    "as it is": lambda values: values,
    "fortran": np.asfortranarray,
    "every other": lambda values: np.repeat(values, 2, axis=0)[::2],
    "backwards": lambda values: values[::-1].copy()[::-1],
    "read only": _read_only,
    "at an odd address": _at_an_odd_address,
}
"""How the same numbers may lie in memory."""


def make_frames(
    numbers: int | npt.ArrayLike,
    tiles: int = 2,
    *,
    period_ns: int = PERIOD_NS,
    utc_offset_ns: int = UTC_NS,
    **columns: npt.ArrayLike,
) -> FrameBatch:
    """Frames with these numbers, or so many from 0 on: unloaded, without servo and without faults.

    Each of `columns` is broadcast to its shape, (frames,) or (frames, tiles), and cast to its type.
    Frame n is taken n periods after the clock began, unless `t_mono_ns` says otherwise.
    """
    seq = np.arange(numbers) if isinstance(numbers, int) else np.asarray(numbers)
    t_mono_ns = columns.get("t_mono_ns", period_ns * seq.astype(np.int64))
    values: dict[str, npt.ArrayLike] = {
        "seq": seq,
        "t_mono_ns": t_mono_ns,
        "t_ns": np.asarray(t_mono_ns, np.int64) + utc_offset_ns,
        "pressure_raw": UNLOADED_COUNTS,
        "temperature_raw": 480,
        "sample_offset_us": 0,
        "servo_counts": NO_SERVO_COUNTS,
        "servo_age_us": NO_SERVO_AGE,
        "tile_flags": 0,
        "frame_flags": 0,
        "reference_force_n": np.nan,
    }
    return _batch(values | columns, len(seq), tiles)


def with_columns(batch: FrameBatch, **columns: npt.ArrayLike) -> FrameBatch:
    """The same frames with other columns, broadcast and cast; `t_ns` follows `t_mono_ns`."""
    values: dict[str, npt.ArrayLike] = {f.name: getattr(batch, f.name) for f in fields(FrameBatch)}
    if "t_mono_ns" in columns:
        values["t_ns"] = np.asarray(columns["t_mono_ns"], np.int64) + batch.t_ns - batch.t_mono_ns
    return _batch(values | columns, len(batch), batch.tile_count)


def loaded_frames(forces_n: npt.ArrayLike, **columns: Any) -> FrameBatch:
    """Frames of tiles of one newton a count under these forces (frames, tiles), rounded.

    NaN is a tile that does not answer. `columns` are those of `make_frames`.
    """
    forces = np.asarray(forces_n, dtype=np.float64)
    silent = np.isnan(forces)
    counts = np.mod(UNLOADED_COUNTS - np.rint(np.where(silent, 0.0, forces)), 1024)
    reading = {
        "pressure_raw": np.where(silent, NOT_READ, counts),
        "temperature_raw": np.where(silent, NOT_READ, 480),
        "tile_flags": np.where(silent, TileFlag.NO_ANSWER, 0),
    }
    return make_frames(len(forces), forces.shape[1], **reading | columns)


def any_frames(rows: int, tiles: int = 2, seed: int = 0, **columns: npt.ArrayLike) -> FrameBatch:
    """Any bits at all in every column that is not given, the ends of every type among them."""
    rng = np.random.default_rng(seed)
    values: dict[str, npt.ArrayLike] = {}
    for name, (dtype, per_tile) in FRAME_COLUMNS.items():
        shape = (rows, tiles) if per_tile else (rows,)
        bits = rng.integers(0, 256, (*shape, dtype.itemsize), dtype=np.uint8)
        column = bits.view(dtype)[..., 0]
        if np.issubdtype(dtype, np.floating):
            ends = np.array([np.nan, np.inf, -np.inf, -0.0, 1e-40, 29.97], dtype)
        else:
            info = np.iinfo(np.dtype(dtype).name)
            ends = np.array([info.min, info.max], dtype)
        values[name] = np.where(rng.random(shape) < 0.3, rng.choice(ends, shape), column)
    return _batch(values | columns, rows, tiles)


def laid_out(batch: FrameBatch, how: str) -> FrameBatch:
    """The same frames, lying in memory as one of `LAYOUTS`."""
    return FrameBatch(**{f.name: LAYOUTS[how](getattr(batch, f.name)) for f in fields(FrameBatch)})


def cut_up(batch: FrameBatch, cuts: Iterable[int], how: str = "as it is") -> list[FrameBatch]:
    """The frames in pieces, each laid out for itself; empty between equal cuts, or at an end."""
    edges = sorted(cut for cut in cuts if 0 <= cut <= len(batch))
    return [laid_out(batch.slice_rows(a, b), how) for a, b in pairwise((0, *edges, len(batch)))]


def assert_same_bits(one: Any, other: Any) -> None:
    """Every column of two `FrameBatch`, or of two `Estimates`, is the same bit by bit."""
    assert type(one) is type(other)
    for f in fields(one):
        a, b = getattr(one, f.name), getattr(other, f.name)
        assert (a.dtype, a.shape) == (b.dtype, b.shape), f.name
        assert a.tobytes() == b.tobytes(), f.name


def _batch(values: dict[str, npt.ArrayLike], rows: int, tiles: int) -> FrameBatch:
    columns: dict[str, Any] = {}
    for name, column in values.items():
        dtype, per_tile = FRAME_COLUMNS[name]
        shape = (rows, tiles) if per_tile else (rows,)
        columns[name] = np.array(np.broadcast_to(np.asarray(column), shape), dtype, order="C")
    return FrameBatch(**columns)
