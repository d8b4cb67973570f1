"""State of an estimate between frames: of every tile, of the foot, and the frames that wait.

Rows are written once and stay in place until the columns are full; then the rows that are still
needed move to the front. So a step costs what its own frames cost, however many wait.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Ints, Times
from devices.flags import CONTACT_UNKNOWN
from devices.frames import NOT_READ
from service.estimation.fault_detection.baseline_loss import BaselineLossState, ThermalDriftState
from service.estimation.fault_detection.clipping import ClippingState
from service.estimation.fault_detection.stuck import StuckState
from service.estimation.foot import ServoReading
from service.estimation.models.ambient import AmbientState
from service.estimation.models.gas import GasState
from service.estimation.models.hysteresis import HysteresisState
from service.estimation.models.rubber import RubberState
from service.estimation.models.skew import SkewState
from service.estimation.models.temperature import TemperatureState
from service.estimation.records import KernelRecord, RecordArray, RecordMatrix


class DomeState(KernelRecord):
    """State of the models of a dome's forces."""

    hysteresis: HysteresisState
    rubber: RubberState


class TileState(KernelRecord):
    """State of a tile."""

    temperature_raw: int = NOT_READ  # last one that was read; `NOT_READ`: none
    temperature_ns: int  # instant of it
    previous_kpa: float = np.nan  # as read in the frame before
    stuck: StuckState
    clipping: ClippingState
    baseline_loss: BaselineLossState
    thermal_drift: ThermalDriftState
    temperature: TemperatureState
    gas: GasState
    # Alternative hypothesis: the state after the load farthest from the best guess of all that are
    # possible, if the tile was saturated, had a gap, or had its first reading under load.
    has_gas_alt: int
    gas_alt: GasState
    skew: SkewState
    dome: DomeState
    has_dome_alt: int
    dome_alt: DomeState
    has_force: int  # 1: the models of the dome have had a force
    is_history_unknown: int  # 1: its alternative is of the loads before the first of them
    previous_force_n: float  # force in the frame before, ...
    previous_force_ns: int  # ... and its instant
    has_previous_force: int


class ContactState(KernelRecord):
    """State of the contact."""

    is_contact: int = CONTACT_UNKNOWN  # contact in the last estimate; unknown until decided
    # Candidate of contact, the instant since which it lasts, and the greatest recent force.
    is_loaded: int = CONTACT_UNKNOWN
    since_ns: int
    peak_n: float
    peak_ns: int


class FootState(KernelRecord):
    """State of the foot."""

    # Rows of the frame buffer: the first without an estimate, the first that the sample stage has
    # not processed, and the one after the last.
    release_row: int
    sample_row: int
    end_row: int
    newest_ns: int  # instant of the newest frame
    run_count: int  # gapless runs so far
    load_changes: int  # loadings and unloadings of all tiles so far
    ambient: AmbientState
    contact: ContactState


ROWS_MIN = 1024
"""Initial number of rows: several times the reach of the windows."""


class FrameRow(KernelRecord):
    """Facts of a frame."""

    seq: np.uint64  # number in the stream
    t_ns: int  # UTC
    after_gap: int  # 1: a gap precedes it
    after_contact_pause: int  # 1: a pause in which the candidate of contact was not observed
    flags: int  # bits of `EstimateFlag` of the frame by itself
    is_contact_bound: int  # 1: tiles are missing, `contact_n` is of the others


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
        contact_n: (n,), sum of the apparent forces, for contact.
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
    contact_n: Floats
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
        contact_n=np.zeros(n_rows),
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
