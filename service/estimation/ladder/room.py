"""What is known of frames that still wait, and of those that windows reach back to: kept columns.

Rows are written once and stay where they are until the columns are full; then what is still needed
moves to the front. So a step costs what its own frames cost, however many wait.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from devices.arrays import Floats, Ints, Times
from service.estimation.foot.kinematics import READING
from service.estimation.records import Records, record_type

ROWS_LEAST = 1024
"""Room for so many frames at first: what windows reach back to, and several times as much."""

ROW = record_type(
    [
        ("seq", np.uint64),  # number in the stream
        ("t_ns", np.int64),  # UTC
        ("broken", np.int64),  # does it come after a gap?
        ("unseen", np.int64),  # or after so long a pause that the foot may have been anywhere?
        ("status", np.int64),  # bits of `EstimateStatus` that it has by itself
        ("loaded", np.int64),  # does the foot seem loaded?
    ]
)
"""Facts of a frame."""

CELL = record_type(
    [
        # As read.
        ("kpa", np.float64),  # absolute pressure; NaN where none could be one
        ("padc", np.int64),
        ("tadc", np.int64),  # held; `NOT_READ` where unknown
        ("over_range", np.int64),
        # As felt.
        ("gauge_kpa", np.float64),  # pressure above the baseline
        ("apparent_n", np.float64),  # force by the static curve
        # Standard uncertainty from all else but noise and gas; does not average away.
        ("sigma_n", np.float64),
        # Likewise what the gas' correction leaves, with the correction's sign: all tiles err to the
        # same side; what the gas did unseen; and what warmth that no model corrects makes of it.
        ("gas_n", np.float64),
        ("unseen_gas_n", np.float64),
        ("warm_n", np.float64),
        ("beyond", np.int64),  # beyond the calibrated range, or the chip's: a lower bound
        ("guess_n", np.float64),  # what it may be where there is only that bound; NaN elsewhere
    ]
)
"""Facts of a tile in a frame."""


class Room(NamedTuple):
    """Columns of up to n frames.

    Attributes:
        rows: (n,), `ROW`.
        cells: (n, tiles), `CELL`.
        readings: (n,), of the servo.
        t_mono_ns: (n,), instants on the monotonic clock.
        run: (n,), number of the unbroken run that each frame belongs to.
        since_ns: (n,), since when the foot has seemed loaded, or not.
        usable_n: (n, tiles + 1), apparent forces that averages may be taken of, and their sum; NaN
            where one is only a lower bound.
        noise_n: (n, tiles + 1), standard deviation that the noise of a single reading gives them.
        sampled_ns: (n, tiles + 1), when they were sampled, on the monotonic clock.
    """

    rows: Records
    cells: Records
    readings: Records
    t_mono_ns: Times
    run: Ints
    since_ns: Times
    usable_n: Floats
    noise_n: Floats
    sampled_ns: Times


def make_room(n: int, tiles: int) -> Room:
    """Empty columns for n frames."""
    return Room(
        rows=np.zeros(n, ROW),
        cells=np.zeros((n, tiles), CELL),
        readings=np.zeros(n, READING),
        t_mono_ns=np.zeros(n, np.int64),
        run=np.zeros(n, np.int64),
        since_ns=np.zeros(n, np.int64),
        usable_n=np.zeros((n, tiles + 1)),
        noise_n=np.zeros((n, tiles + 1)),
        sampled_ns=np.zeros((n, tiles + 1), np.int64),
    )


def moved(room: Room, first: int, end: int, more: int) -> Room:
    """Rows `first` to `end` at the front, with room for `more` after them."""
    # Twice what is needed, or every step would move what is kept.
    twice = 2 * (end - first + more)
    to = room if twice <= len(room.rows) else make_room(twice, room.cells.shape[1])
    for old, new in zip(room, to, strict=True):
        new[: end - first] = old[first:end]
    return to
