"""Foot as a whole: geometry of its tiles, and its angle at a frame's instant.

Axes as in the design: foot frame x forward, y to the left, z up the segment, origin at the ankle.
A positive angle is a roll forward (right-handed about y).

A frame has the newest reading of the angle, which is up to a reading's interval old. The next
reading comes with a later frame. If that lies within the look-ahead, the position at the frame's
instant lies on the straight line between the two; else the previous reading holds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from devices.arrays import Floats
from devices.flags import FrameFlag
from devices.frames import NO_SERVO_COUNTS, SAME_PLACE_M, ServoInfo
from devices.jit import jit_cached, jit_inlined
from service.estimation.records import KernelRecord, RecordArray

_PARABOLA_POSITIONS_MIN = 3  # least positions along x that determine a parabola


class HalfPlanes(NamedTuple):
    """Half-planes `normals @ p <= offsets_m`, (k, 2) of unit length and (k,)."""

    normals: Floats
    offsets_m: Floats


def compute_hull_half_planes(positions_m: Floats) -> HalfPlanes:
    """Compute the half-planes whose intersection is the hull of (tiles, 2).

    Tiles in a line, or a single one, have a hull without area: two half-planes across every
    direction in which they do not extend would forbid any noise, so only the ends of the line
    count; across it a force-weighted mean cannot leave the line anyway.
    """
    centre_m = positions_m.mean(axis=0)
    _, spread_m, directions = np.linalg.svd(positions_m - centre_m)
    extends = np.zeros(2, dtype=bool)
    extends[: len(spread_m)] = spread_m > SAME_PLACE_M
    if extends.all():
        from scipy.spatial import ConvexHull

        equations = ConvexHull(positions_m).equations
        return HalfPlanes(equations[:, :2], -equations[:, 2])
    normals = np.concatenate([directions[extends], -directions[extends]])
    return HalfPlanes(normals, (positions_m @ normals.T).max(axis=0, initial=-np.inf))


def compute_grid_indices_from_1(
    positions_m: Floats,
) -> tuple[Floats, Floats] | None:
    """Return each tile's index along x and y, from 1 (paper eq. 4); None if they fill no grid.

    A line of tiles is a grid of one row.
    """
    columns, x = np.unique(np.round(positions_m[:, 0] / SAME_PLACE_M), return_inverse=True)
    rows, y = np.unique(np.round(positions_m[:, 1] / SAME_PLACE_M), return_inverse=True)
    places = set(zip(x.tolist(), y.tolist(), strict=True))
    if len(places) != len(positions_m) or len(places) != len(columns) * len(rows):
        return None
    return x.astype(np.float64) + 1.0, y.astype(np.float64) + 1.0


def fit_tile_axis_angles_rad(positions_m: Floats) -> Floats:
    """Fit the sole, and return the angle of each tile's axis to the segment, (tiles,).

    Tiles stand upright on their sole, whose shape along x is a parabola through their positions
    (tiles, 3). Zero if these do not determine it. As the segment rolls, tiles are vertical in turn.
    """
    x_m, z_m = positions_m[:, 0], positions_m[:, 2]
    if len(np.unique(np.round(x_m / SAME_PLACE_M))) < _PARABOLA_POSITIONS_MIN:
        return np.zeros(len(positions_m))
    design = np.stack([np.ones(len(x_m)), x_m, x_m**2], axis=1)
    (_, slope, bend), *_ = np.linalg.lstsq(design, z_m, rcond=None)
    return np.asarray(np.arctan(slope + 2.0 * bend * x_m))


def compute_tilt_loss(axis_rad: Floats) -> Floats:
    """Return the part of a force along each tile's axis that is not along the segment: 1 - cos."""
    return np.asarray(1.0 - np.cos(axis_rad))


def compute_segment_rad_per_count(servo: ServoInfo) -> float:
    """Return the segment's angle in rad for one count of the servo, signed."""
    return servo.sign * servo.ratio * 2.0 * math.pi / servo.counts_per_turn


@jit_cached
def transform_to_ground_x_m(
    x_m: float, z_m: float, angle_rad: float, ankle_travel_m_per_rad: float
) -> float:
    """Transform a point's x from foot to ground frame (paper eq. 3 with l = -z, r = -x).

    ankle travel + x cos(angle) + z sin(angle); NaN where the ankle's travel is.
    """
    turned_m = x_m * math.cos(angle_rad) + z_m * math.sin(angle_rad)
    return ankle_travel_m_per_rad * angle_rad + turned_m


_AGE_UNIT_NS = 1000
"""Unit of ages: instants of one reading from two frames may differ by this."""
_UNKNOWN = int(FrameFlag.SERVO_STALE | FrameFlag.SERVO_TURN_UNKNOWN)


class ServoReading(KernelRecord):
    """Reading of the servo in a frame."""

    t_ns: int  # instant of the frame
    sampled_ns: int  # instant of the reading; undefined without an age
    counts: int
    is_valid: int  # 1: there is a reading, not stale, and its turn is known
    has_age: int  # 1: valid, and its age is known
    is_new: int  # 1: another than that of the frame before, or none
    is_next: int  # 1: the reading directly after that of the frame before


@jit_inlined
def store_servo_reading_and_link_to_previous(
    readings: RecordArray[ServoReading],
    i: int,
    t_ns: int,
    counts: int,
    age_us: int,
    frame_flags: int,
    counts_per_turn: int,
    after_gap: bool,
) -> None:
    """Store the servo reading of frame `i`.

    Args:
        readings: (n,), of the frames before; updated.
        i: row; 0 is the first frame of all.
        t_ns: instant of the frame.
        counts: `servo_counts`.
        age_us: `servo_age_us`.
        frame_flags: bits of `FrameFlag`.
        counts_per_turn: of the servo. A change of half a turn or more between two readings is a
            wrap from the end of the turn to its beginning.
        after_gap: whether a gap precedes the frame; its reading then has no predecessor.
    """
    now, before = readings[i], readings[max(i - 1, 0)]
    now.t_ns, now.sampled_ns, now.counts = t_ns, t_ns - age_us * _AGE_UNIT_NS, counts
    now.is_valid = 1 if counts != NO_SERVO_COUNTS and (frame_flags & _UNKNOWN) == 0 else 0
    now.has_age = 1 if now.is_valid == 1 and age_us >= 0 else 0
    unbroken = i > 0 and now.has_age == 1 and before.has_age == 1 and not after_gap
    later_ns, moved = now.sampled_ns - before.sampled_ns, abs(counts - before.counts)
    same = unbroken and abs(later_ns) < _AGE_UNIT_NS and moved == 0
    now.is_new = 0 if same else 1
    is_next = unbroken and later_ns >= _AGE_UNIT_NS and 2 * moved < counts_per_turn
    now.is_next = 1 if is_next else 0


@jit_inlined
def interpolate_servo_counts(
    readings: RecordArray[ServoReading], i: int, end: int, lag_ns: int
) -> float:
    """Interpolate the servo position to the instant of frame `i`, in counts; NaN where unknown.

    Args:
        readings: of all frames up to `lag_ns` after it.
        i: row.
        end: row after the last that is stored.
        lag_ns: look-ahead.
    """
    t_ns, here = readings[i].t_ns, i
    if readings[i].is_valid == 0:
        return math.nan
    after = _find_next_reading(readings, here, end, t_ns + lag_ns)
    # A reading that was on its way at the frame's instant was sampled before it.
    if after >= 0 and readings[after].sampled_ns <= t_ns:
        here = after
        after = _find_next_reading(readings, here, end, t_ns + lag_ns)
    counts = float(readings[here].counts)
    if after < 0 or readings[after].sampled_ns <= t_ns:
        return counts
    interval_ns = readings[after].sampled_ns - readings[here].sampled_ns
    part = (t_ns - readings[here].sampled_ns) / interval_ns
    return counts + part * (readings[after].counts - readings[here].counts)


@jit_inlined
def _find_next_reading(
    readings: RecordArray[ServoReading], at: int, end: int, until_ns: int
) -> int:
    """Return the frame with the reading directly after that of frame `at`; -1: none."""
    after = at + 1
    # At the end of the look-ahead only the first frame is there for certain; without any, none.
    while after < end and readings[after].t_ns <= until_ns and readings[after - 1].t_ns < until_ns:
        if readings[after].is_new == 1:
            return after if readings[after].is_next == 1 else -1
        after += 1
    return -1
