"""Zero-order hold of the tiles' temperature, for at most a second.

An array may read `temperature_raw` in every k-th frame only. A pressure cannot be computed without
it, but a chip's temperature changes in a second by less than matters (0.04 kPa per count). Stored
frames keep `NOT_READ`, so the age of a temperature is always known; only the computation of
pressures fills it in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from devices.arrays import Times
from devices.flags import TileFlag
from devices.frames import NOT_READ, FrameBatch

HOLD_MAX_NS = 1_000_000_000
"""Longest hold; an older temperature is not used."""


@dataclass(frozen=True)
class HeldTemperature:
    """Last temperature of each tile and its instant; `NOT_READ` for none.

    Attributes:
        temperature_raw: uint16[tiles].
        t_mono_ns: int64[tiles].
    """

    temperature_raw: npt.NDArray[np.uint16]
    t_mono_ns: Times


def hold_temperature(
    frames: FrameBatch, held: HeldTemperature | None = None
) -> tuple[FrameBatch, HeldTemperature]:
    """Fill in missing temperatures with the last one of each tile, if it is not too old.

    The result does not depend on the split of a stream into batches, if `held` is passed on.

    Args:
        frames: n frames in order.
        held: state returned for the previous frames.

    Returns:
        The filled frames, and the state for the next ones.
    """
    tiles = frames.tile_count
    if held is None:
        held = HeldTemperature(
            np.full(tiles, NOT_READ, dtype=np.uint16), np.zeros(tiles, dtype=np.int64)
        )
    if not len(frames):
        return frames, held
    unusable = (frames.tile_flags & np.uint8(TileFlag.UNUSABLE)) != 0
    missing = frames.temperature_raw == NOT_READ
    known = ~(missing | unusable)
    if known.all():  # the usual case
        return frames, HeldTemperature(
            frames.temperature_raw[-1].copy(), np.full(tiles, frames.t_mono_ns[-1])
        )
    # Row 0 is the held state; every row then looks up the last known one.
    temperature_raw = np.concatenate([held.temperature_raw[None], frames.temperature_raw])
    t_mono_ns = np.concatenate(
        [
            held.t_mono_ns[None],
            np.broadcast_to(frames.t_mono_ns[:, None], frames.temperature_raw.shape),
        ]
    )
    rows = np.where(known, np.arange(1, len(frames) + 1)[:, None], 0)
    newest = np.maximum.accumulate(rows, axis=0)
    columns = np.arange(tiles)
    last = HeldTemperature(temperature_raw[newest[-1], columns], t_mono_ns[newest[-1], columns])
    if not missing.any():
        return frames, last
    found = temperature_raw[newest, columns]
    too_old = frames.t_mono_ns[:, None] - t_mono_ns[newest, columns] > HOLD_MAX_NS
    filled = np.where(missing & ~too_old, found, frames.temperature_raw)
    return replace(frames, temperature_raw=filled), last
