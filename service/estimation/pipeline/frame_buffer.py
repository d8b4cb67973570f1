"""Column buffer of the frames that wait for their look-ahead, or that windows reach back to.

Rows are written once and stay in place until the columns are full; then the rows that are still
needed move to the front. So a step costs what its own frames cost, however many wait.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Ints, Times
from service.estimation.foot.kinematics import ServoReading
from service.estimation.records import KernelRecord, RecordArray, RecordMatrix

ROWS_MIN = 1024
"""Initial number of rows: several times the reach of the windows."""


class FrameRow(KernelRecord):
    """Facts of a frame."""

    seq: np.uint64  # number in the stream
    t_ns: int  # UTC
    after_gap: int  # 1: a gap precedes it
    after_long_gap: int  # 1: so long that the foot may have been anywhere
    flags: int  # bits of `EstimateFlag` of the frame by itself
    is_loaded: int  # 1: candidate of contact


class TileSample(KernelRecord):
    """Facts of a tile in a frame."""

    # As read.
    pressure_kpa: float  # absolute; NaN where invalid
    pressure_raw: int
    temperature_raw: int  # zero-order hold; `NOT_READ` where unknown
    is_over_range: int  # flagged by the driver
    # By the sample stage.
    gauge_kpa: float  # pressure above the baseline
    apparent_n: float  # force by the static curve
    # Standard uncertainty by all but noise and gas; averaging does not reduce it.
    systematic_sigma_n: float
    # Signed errors that all tiles share: remaining error of the gas correction, the gas' unknown
    # state after saturation or a gap, and warmth that no model corrects.
    gas_error_n: float
    gas_alt_error_n: float
    thermal_error_n: float
    is_saturated: int  # beyond the calibrated range, or the chip's: a lower bound
    extrapolated_n: float  # best guess while saturated; NaN elsewhere


class FrameBuffer(NamedTuple):
    """Columns of up to n frames.

    Attributes:
        rows: (n,), frames.
        samples: (n, tiles), tiles in frames.
        readings: (n,), of the servo.
        t_mono_ns: (n,), instants on the monotonic clock.
        run: (n,), number of the gapless run of each frame.
        since_ns: (n,), `ContactState.since_ns` after each frame.
        usable_n: (n, tiles + 1), apparent forces for averaging, and their sum; NaN while
            saturated.
        noise_n: (n, tiles + 1), standard deviation of these by the noise of a single reading.
        sampled_ns: (n, tiles + 1), their instants on the monotonic clock.
    """

    rows: RecordArray[FrameRow]
    samples: RecordMatrix[TileSample]
    readings: RecordArray[ServoReading]
    t_mono_ns: Times
    run: Ints
    since_ns: Times
    usable_n: Floats
    noise_n: Floats
    sampled_ns: Times


def make_frame_buffer(n_rows: int, tiles: int) -> FrameBuffer:
    """Allocate columns for n frames."""
    return FrameBuffer(
        rows=np.zeros(n_rows, FrameRow.dtype()),
        samples=np.zeros((n_rows, tiles), TileSample.dtype()),
        readings=np.zeros(n_rows, ServoReading.dtype()),
        t_mono_ns=np.zeros(n_rows, np.int64),
        run=np.zeros(n_rows, np.int64),
        since_ns=np.zeros(n_rows, np.int64),
        usable_n=np.zeros((n_rows, tiles + 1)),
        noise_n=np.zeros((n_rows, tiles + 1)),
        sampled_ns=np.zeros((n_rows, tiles + 1), np.int64),
    )


def compact_or_grow_buffer(buffer: FrameBuffer, first: int, end: int, new_rows: int) -> FrameBuffer:
    """Move rows `first` to `end` to the front, in a larger buffer if `new_rows` more would not fit.

    Returns:
        The same buffer, or a larger one.
    """
    # Twice what is needed, or every step would move all rows.
    twice = 2 * (end - first + new_rows)
    fits = twice <= len(buffer.rows)
    to = buffer if fits else make_frame_buffer(twice, buffer.usable_n.shape[1] - 1)
    columns, targets = cast("tuple[tuple[npt.NDArray[Any], ...], ...]", (buffer, to))
    for old, new in zip(columns, targets, strict=True):
        new[: end - first] = old[first:end]
    return to
