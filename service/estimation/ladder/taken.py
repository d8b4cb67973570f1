"""Frames as they come: what is read of them into the room, before anything is made of it."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from devices.arrays import Times
from devices.chips import mpl115a2
from devices.chips.mpl115a2 import PRESSURE_MIN_KPA
from devices.compiled import compiled, inlined
from devices.frames import NOT_READ, TileStatus
from devices.temperature import HELD_NS
from service.estimation.foot import UNSEEN_NS
from service.estimation.foot.kinematics import carry
from service.estimation.ladder.laws import Laws
from service.estimation.ladder.room import Room
from service.estimation.models.unwrap import unwrapped
from service.estimation.records import Record, Records

_UNUSABLE = int(TileStatus.UNUSABLE)
_OVER_RANGE = int(TileStatus.OVER_RANGE)
_kpa_of = compiled(mpl115a2.kpa_of)
_kpa_per_count_of = compiled(mpl115a2.kpa_per_count_of)


@inlined
def take(
    laws: Laws,
    scene: Record,
    tiles: Records,
    room: Room,
    seq: npt.NDArray[np.uint64],
    t_mono_ns: Times,
    t_ns: Times,
    padc: npt.NDArray[np.uint16],
    tadc: npt.NDArray[np.uint16],
    sample_offset_us: npt.NDArray[np.int32],
    servo_counts: npt.NDArray[np.int32],
    servo_age_us: npt.NDArray[np.int32],
    status: npt.NDArray[np.uint8],
    frame_status: npt.NDArray[np.uint8],
) -> None:
    """Write n frames behind the last row, columns as in `FrameBatch`."""
    law = laws.scene[0]
    for k in range(len(seq)):
        i = scene.end
        row, now_ns = room.rows[i], t_mono_ns[k]
        row.seq, row.t_ns, room.t_mono_ns[i] = seq[k], t_ns[k], now_ns
        broken = unseen = False
        if i > 0:  # a row is always left of the frames before
            passed_ns = now_ns - room.t_mono_ns[i - 1]
            # Unsigned throughout: a difference wraps, and any number is compared as it is.
            follows = np.uint64(seq[k] - room.rows[i - 1].seq) == np.uint64(1)
            broken, unseen = not follows or passed_ns > law.gap_ns, passed_ns > UNSEEN_NS
        row.broken, row.unseen = 1 if broken else 0, 1 if unseen else 0
        scene.runs += row.broken
        room.run[i] = scene.runs
        if law.servo == 1:
            carry(
                room.readings, i, now_ns, np.int64(servo_counts[k]), np.int64(servo_age_us[k]),
                frame_status[k], law.counts_per_turn, broken,
            )  # fmt: skip
        for j in range(len(tiles)):
            tile, cell, chip = tiles[j], room.cells[i, j], laws.tiles[j]
            of_tile = np.int64(status[k, j])
            cell.over_range = of_tile & _OVER_RANGE
            cell.padc, cell.tadc = padc[k, j], tadc[k, j]
            if cell.tadc == NOT_READ:  # a chip's temperature holds for a second
                if now_ns - tile.tadc_ns <= HELD_NS:
                    cell.tadc = tile.tadc
            elif of_tile & _UNUSABLE == 0:
                tile.tadc, tile.tadc_ns = cell.tadc, now_ns
            room.sampled_ns[i, j] = now_ns + 1000 * np.int64(sample_offset_us[k, j]) + chip.late_ns
            cell.kpa = math.nan
            if of_tile & _UNUSABLE == 0 and cell.padc != NOT_READ and cell.tadc != NOT_READ:
                p, t = float(cell.padc), float(cell.tadc)
                kpa = _kpa_of(p, t, chip.a0, chip.b1, chip.b2, chip.c12)
                if law.unwrap == 1:
                    kpa = unwrapped(kpa, _kpa_per_count_of(t, chip.b1, chip.c12))
                if kpa >= PRESSURE_MIN_KPA:
                    cell.kpa = kpa
        scene.newest_ns = now_ns
        scene.end += 1
