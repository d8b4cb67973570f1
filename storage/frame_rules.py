"""Rules that the frames of a stream keep, for a server's intake and for `verify`.

Both use the same rules. So no frame is acknowledged and sealed as complete that is later reported
as damaged.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from devices.arrays import Times
from devices.chips.pressure_chip import Counts
from devices.chips.pressure_chips import get_chip
from devices.flags import FrameFlag, TileFlag
from devices.frames import NO_SERVO_AGE, NOT_READ, RAW_COLUMNS, ArrayInfo, FrameBatch
from devices.types import T_MONO_NS_END, T_NS_END

_MAX_SAMPLE_OFFSET_US = 60_000_000
"""Upper limit of `sample_offset_us`: a tile is read within its frame, in less than a minute."""
_FORCE_MAX_N = 1e6
_TILE_BITS = sum(TileFlag)
_FRAME_BITS = sum(FrameFlag)

ViolationMask = npt.NDArray[np.bool_]
"""Mask of the rows that break a rule."""


def describe_first_broken_rule(frames: FrameBatch, info: ArrayInfo) -> str:
    """Return a text that names the first broken rule and frame; empty if there is none.

    Args:
        frames: frames of one message, `seq` rising by one.
        info: the array of their stream.
    """
    for rule, wrong in _rules(frames, info):
        if np.count_nonzero(wrong):  # a third of the time of `any`, and nearly always 0
            row = int(np.flatnonzero(wrong if wrong.ndim == 1 else wrong.any(axis=1))[0])
            return f"{rule} in frame {int(frames.seq[row])}"
    return ""


def mask_out_of_range_times(t_mono_ns: Times, t_ns: Times) -> ViolationMask:
    """Return a mask of impossible instants, int64[n] each.

    Differences of all others fit 64 bits.
    """
    mono = (t_mono_ns <= -T_MONO_NS_END) | (t_mono_ns >= T_MONO_NS_END)
    return mono | (t_ns < 0) | (t_ns >= T_NS_END)


def find_time_reversals(t_ns_first: Times, t_ns_last: Times) -> npt.NDArray[np.intp]:
    """Return the indices of batches that begin before the batch before them has ended.

    Args:
        t_ns_first: int64[n], instant of each batch's first frame; batches in order of numbers.
        t_ns_last: int64[n], instant of each batch's last frame.
    """
    return np.flatnonzero(t_ns_first[1:] < t_ns_last[:-1]) + 1


def _rules(frames: FrameBatch, info: ArrayInfo) -> Iterator[tuple[str, ViolationMask]]:
    t_mono_ns, t_ns = frames.t_mono_ns, frames.t_ns
    # This first: within the range no difference of instants wraps.
    yield (
        "t_ns is outside of the years 1970 to 2199, or t_mono_ns beyond 36 years",
        mask_out_of_range_times(t_mono_ns, t_ns),
    )
    yield (
        f"t_ns is not t_mono_ns plus the {info.utc_offset_ns} ns announced with the stream",
        t_ns - t_mono_ns != info.utc_offset_ns,
    )
    back = np.zeros(len(t_mono_ns), np.bool_)
    np.less(t_mono_ns[1:], t_mono_ns[:-1], out=back[1:])
    yield "t_mono_ns runs backwards", back
    limits = _get_counts_max(tuple([tile.chip for tile in info.tiles]))
    for name, most in zip(RAW_COLUMNS, limits, strict=True):
        counts = getattr(frames, name)
        yield f"{name} is more than the chip can give", (counts > most) & (counts != NOT_READ)
    offset_us = frames.sample_offset_us
    yield (
        "a tile was sampled more than a minute away",
        (offset_us > _MAX_SAMPLE_OFFSET_US) | (offset_us < -_MAX_SAMPLE_OFFSET_US),
    )
    yield "servo_age_us is negative", frames.servo_age_us < NO_SERVO_AGE
    yield "tile_flags has undefined bits", (frames.tile_flags & ~np.uint8(_TILE_BITS)) != 0
    yield ("frame_flags has undefined bits", (frames.frame_flags & ~np.uint8(_FRAME_BITS)) != 0)
    force_n = frames.reference_force_n
    yield "reference_force_n is no force", ~np.isnan(force_n) & ~(np.abs(force_n) <= _FORCE_MAX_N)


@lru_cache(maxsize=64)
def _get_counts_max(chips: tuple[str, ...]) -> Counts | npt.NDArray[np.uint32]:
    """Return the largest counts of pressure and of temperature: of all chips, or (2, tiles)."""
    limits = [get_chip(name).counts_max for name in chips]
    if len(set(limits)) == 1:
        return limits[0]
    return np.array(limits, np.uint32).reshape(-1, 2).T
