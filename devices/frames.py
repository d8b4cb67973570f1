"""What a node measures: frames in batches, the flags they carry, and the array they came from.

A `FrameBatch` is the one form of data between driver, disk, wire and estimator: contiguous numpy
columns, time first. There is no single-frame class. Counts are kept as read; what was not read is
`NOT_READ`, what is not known is NaN, never zero and never the last value.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict

from devices.arrays import Arrays, Times

NOT_READ = 65535
NO_SERVO_COUNTS = -(2**31)
NO_SERVO_AGE = -1


class TileStatus(IntFlag):
    """Bits of `FrameBatch.status`, one value per tile and frame."""

    NO_ANSWER = 1
    """The tile did not acknowledge; its counts are `NOT_READ`."""
    STALE = 2
    """The same two words came again and again: the part must have stopped converting."""
    RETRIED = 4
    """It took a second attempt, or a third reading, in this frame; the reading is good."""
    IMPLAUSIBLE = 8
    """No part gives these words, or they could not be confirmed, or another part gave them."""
    OVER_RANGE = 16
    """Outside the chip's 50 to 115 kPa, or at the end of its counts."""
    NOT_CONVERTED = 32
    """Zeros, as the registers of a part that was just powered up, or no conversion that was
    finished in this frame."""

    UNUSABLE = NO_ANSWER | STALE | IMPLAUSIBLE | NOT_CONVERTED
    """No pressure can be computed from this tile in this frame."""


class FrameStatus(IntFlag):
    """Bits of `FrameBatch.frame_status`, one value per frame."""

    OVERRUN = 1
    """The frame began after its slot had passed; slots before it were missed."""
    SERVO_STALE = 2
    """The newest servo position is older than it should be."""
    BUS_FAULT = 4
    """The bus itself failed in this frame (not one tile)."""
    LEAD = 8
    """Taken before a load trace begins: the foot is unloaded."""
    NEW_ARRAY_INFO = 16
    """The array was identified again before this frame."""


@dataclass(frozen=True)
class FrameBatch(Arrays):
    """n frames of an array of tiles, in the order they were taken.

    Attributes:
        seq: uint64[n], number of the frame in its stream, from 0.
        t_mono_ns: int64[n], CLOCK_MONOTONIC at the sample instant of the frame's first tile.
        t_ns: int64[n], the same instant in UTC ns since 1970 (`t_mono_ns` + the stream's anchor).
        padc: uint16[n, tiles], raw 10-bit pressure counts; `NOT_READ` where not read.
        tadc: uint16[n, tiles], raw 10-bit temperature counts; `NOT_READ` where not read.
        sample_offset_us: int32[n, tiles], each tile's sample instant minus `t_ns`.
        servo_counts: int32[n], newest position; `NO_SERVO_COUNTS` without servo.
        servo_age_us: int32[n], its age at `t_ns`; `NO_SERVO_AGE` without servo.
        status: uint8[n, tiles], `TileStatus` bits.
        frame_status: uint8[n], `FrameStatus` bits.
        reference_force_n: float32[n], the calibration rig's force; NaN without.
    """

    seq: npt.NDArray[np.uint64]
    t_mono_ns: Times
    t_ns: Times
    padc: npt.NDArray[np.uint16]
    tadc: npt.NDArray[np.uint16]
    sample_offset_us: npt.NDArray[np.int32]
    servo_counts: npt.NDArray[np.int32]
    servo_age_us: npt.NDArray[np.int32]
    status: npt.NDArray[np.uint8]
    frame_status: npt.NDArray[np.uint8]
    reference_force_n: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        n, tiles = self.padc.shape
        for name, (dtype, per_tile) in FRAME_COLUMNS.items():
            column = getattr(self, name)
            shape = (n, tiles) if per_tile else (n,)
            if column.shape != shape or column.dtype != dtype:
                raise ValueError(
                    f"FrameBatch.{name}: expected {np.dtype(dtype)}{shape}, "
                    f"got {column.dtype}{column.shape}"
                )

    def __len__(self) -> int:
        return len(self.seq)

    @property
    def tile_count(self) -> int:
        """Number of tiles of the array."""
        return int(self.padc.shape[1])


FRAME_COLUMNS: dict[str, tuple[type[np.generic], bool]] = {
    "seq": (np.uint64, False),
    "t_mono_ns": (np.int64, False),
    "t_ns": (np.int64, False),
    "padc": (np.uint16, True),
    "tadc": (np.uint16, True),
    "sample_offset_us": (np.int32, True),
    "servo_counts": (np.int32, False),
    "servo_age_us": (np.int32, False),
    "status": (np.uint8, True),
    "frame_status": (np.uint8, False),
    "reference_force_n": (np.float32, False),
}
"""Type of every column, and whether it has one value per tile."""


def zero_columns(n: int, tiles: int) -> dict[str, np.ndarray]:
    """Columns of n frames, to be filled in."""
    return {
        name: np.zeros((n, tiles) if per_tile else n, dtype)
        for name, (dtype, per_tile) in FRAME_COLUMNS.items()
    }


class _Fact(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TileInfo(_Fact):
    """One tile as found on the bus at start-up."""

    serial: str
    mux: int
    channel: int
    coefficient_words: tuple[int, int, int, int]
    """Registers a0, b1, b2, c12 as unsigned 16-bit words (data sheet table 4)."""
    x_m: float
    y_m: float
    z_m: float
    reference: bool
    conversion_ms: float
    """Conversion time as measured, else the data sheet's typical 1.6 ms. The sample is taken to lie
    a quarter into it."""


class ServoInfo(_Fact):
    """The servo whose position goes with the frames, and how it becomes the segment's angle."""

    model: str
    counts_per_turn: int
    zero_counts: int
    sign: int
    ratio: float
    ankle_travel_m_per_rad: float | None
    """How far the ankle moves forward per radian (radius of a rolling foot); None: not known."""


class ArrayInfo(_Fact):
    """Everything a reader of the frames needs to know of the array. Travels as JSON with them."""

    node: str
    boot_id: str
    tiles: tuple[TileInfo, ...]
    servo: ServoInfo | None
    schedule: str
    nominal_rate_hz: float
    utc_offset_ns: int
    """`t_ns` minus `t_mono_ns` of every frame of this stream."""
    clock_set: bool
    software: str
    scene: str
    models: tuple[str, ...]

    def has_same_tiles_as(self, other: ArrayInfo) -> bool:
        """Are these the same chips in the same places?

        Conversion times are measured at each start and differ by some microseconds.
        """

        def places(info: ArrayInfo) -> list[TileInfo]:
            return [tile.model_copy(update={"conversion_ms": 0.0}) for tile in info.tiles]

        return places(self) == places(other)

    @property
    def serials(self) -> tuple[str, ...]:
        """Serials in the order of the tiles in a frame."""
        return tuple(tile.serial for tile in self.tiles)
