"""Raw data of a node: frames in batches, their flags, and the description of their array.

Driver, disk, wire and estimator all exchange a `FrameBatch`: contiguous numpy columns, time first.
Counts stay as read. A missing count is `NOT_READ`, an unknown number is NaN, never zero and never
the last value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from devices.arrays import ArrayRecord, Times
from devices.types import (
    MODELS_MAX,
    RATE_HZ_MIN,
    TILES_MAX,
    Identifier,
    Metres,
    OffsetNs,
    StrictModel,
    UInt16,
)

NOT_READ = 65535
NO_SERVO_COUNTS = -(2**31)
NO_SERVO_AGE = -1
SAME_PLACE_M = 1e-6
"""Tiles that differ by no more along an axis stand in one row."""


@dataclass(frozen=True)
class FrameBatch(ArrayRecord):
    """Batch of n frames of an array, in time order.

    Attributes:
        seq: uint64[n], number of the frame in its stream, from 0.
        t_mono_ns: int64[n], CLOCK_MONOTONIC at the sample instant of the frame's first tile.
        t_ns: int64[n], the same instant in UTC ns since 1970 (`t_mono_ns` + the stream's anchor).
        pressure_raw: uint16[n, tiles], raw 10-bit pressure counts; `NOT_READ` where not read.
        temperature_raw: uint16[n, tiles], raw 10-bit temperature counts; `NOT_READ` where not read.
        sample_offset_us: int32[n, tiles], each tile's sample instant minus `t_ns`.
        servo_counts: int32[n], newest position, continued over whole turns (see
            `devices.chips.dynamixel.position_sources`); `NO_SERVO_COUNTS` without servo.
        servo_age_us: int32[n], its age at `t_ns`; `NO_SERVO_AGE` without servo.
        tile_flags: uint8[n, tiles], `TileFlag` bits.
        frame_flags: uint8[n], `FrameFlag` bits.
        reference_force_n: float32[n], the calibration rig's force; NaN without.
    """

    seq: npt.NDArray[np.uint64]
    t_mono_ns: Times
    t_ns: Times
    pressure_raw: npt.NDArray[np.uint16]
    temperature_raw: npt.NDArray[np.uint16]
    sample_offset_us: npt.NDArray[np.int32]
    servo_counts: npt.NDArray[np.int32]
    servo_age_us: npt.NDArray[np.int32]
    tile_flags: npt.NDArray[np.uint8]
    frame_flags: npt.NDArray[np.uint8]
    reference_force_n: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        by_tile = self.pressure_raw.shape
        by_frame = by_tile[:1]
        for name, (dtype, per_tile) in FRAME_COLUMNS.items():
            column = getattr(self, name)
            shape = by_tile if per_tile else by_frame
            if column.shape != shape or column.dtype != dtype:
                raise ValueError(
                    f"FrameBatch.{name}: expected {dtype}{shape}, got {column.dtype}{column.shape}"
                )

    def __len__(self) -> int:
        return len(self.seq)

    @property
    def tile_count(self) -> int:
        """Number of tiles of the array."""
        return int(self.pressure_raw.shape[1])


FRAME_COLUMNS: dict[str, tuple[np.dtype[Any], bool]] = {
    "seq": (np.dtype(np.uint64), False),
    "t_mono_ns": (np.dtype(np.int64), False),
    "t_ns": (np.dtype(np.int64), False),
    "pressure_raw": (np.dtype(np.uint16), True),
    "temperature_raw": (np.dtype(np.uint16), True),
    "sample_offset_us": (np.dtype(np.int32), True),
    "servo_counts": (np.dtype(np.int32), False),
    "servo_age_us": (np.dtype(np.int32), False),
    "tile_flags": (np.dtype(np.uint8), True),
    "frame_flags": (np.dtype(np.uint8), False),
    "reference_force_n": (np.dtype(np.float32), False),
}
"""Data type of every column, and whether it has one value per tile."""


def allocate_columns(frame_count: int, tile_count: int) -> dict[str, np.ndarray]:
    """Allocate zeroed columns for n frames."""
    return {
        name: np.zeros((frame_count, tile_count) if per_tile else frame_count, dtype)
        for name, (dtype, per_tile) in FRAME_COLUMNS.items()
    }


_Factor = Annotated[float, Field(ge=-1e6, le=1e6)]


class TileInfo(StrictModel):
    """Tile as identified on the bus at start-up."""

    serial: Identifier
    mux: Annotated[int, Field(ge=0, le=0x7F)]
    channel: Annotated[int, Field(ge=0, le=7)]
    coefficient_words: tuple[UInt16, UInt16, UInt16, UInt16]
    """Registers a0, b1, b2, c12 as unsigned 16-bit words (data sheet table 4)."""
    x_m: Metres
    y_m: Metres
    z_m: Metres
    reference: bool
    conversion_ms: Annotated[float, Field(gt=0, le=1000)]
    """Conversion time as measured, else the data sheet's typical 1.6 ms. The sample instant is
    taken to be a quarter into it."""


class ServoInfo(StrictModel):
    """Servo of a stream, and the conversion of its position to the segment's angle."""

    model: Identifier
    counts_per_turn: Annotated[int, Field(gt=0, lt=2**31)]
    zero_counts: Annotated[int, Field(ge=-(2**31), lt=2**31)]
    sign: Literal[-1, 1]
    ratio: _Factor
    ankle_travel_m_per_rad: _Factor | None
    """Forward travel of the ankle per radian (radius of a rolling foot); None: not known."""


class ArrayInfo(StrictModel):
    """Description of an array, sent as JSON with its frames."""

    node: Identifier
    stream_id: Identifier
    tiles: Annotated[tuple[TileInfo, ...], Field(max_length=TILES_MAX)]
    servo: ServoInfo | None
    schedule: Identifier
    nominal_rate_hz: Annotated[float, Field(ge=RATE_HZ_MIN, le=1e5)]
    utc_offset_ns: OffsetNs
    """`t_ns` minus `t_mono_ns` of every frame of this stream."""
    clock_set: bool
    software: Identifier
    scene: Identifier
    models: Annotated[tuple[Identifier, ...], Field(max_length=MODELS_MAX)]

    @model_validator(mode="after")
    def _tiles_differ(self) -> Self:
        if len(set(self.serials)) < len(self.tiles):
            raise ValueError("two tiles have the same serial")
        return self

    def has_same_tiles_as(self, other: ArrayInfo) -> bool:
        """Return whether both arrays have the same chips in the same places.

        Conversion times are ignored: they are measured at each start and differ by microseconds.
        """

        def places(info: ArrayInfo) -> list[TileInfo]:
            return [tile.model_copy(update={"conversion_ms": 0.0}) for tile in info.tiles]

        return places(self) == places(other)

    @property
    def serials(self) -> tuple[str, ...]:
        """Serials of the tiles, in frame order."""
        return tuple(tile.serial for tile in self.tiles)

    @property
    def row_place_m(self) -> tuple[float | None, float | None]:
        """Place along x and y of the row in which all loaded tiles stand; None without such a row.

        A row measures no centre of pressure along the axis that it has a place on.
        """

        def common(places_m: list[float]) -> float | None:
            is_row = bool(places_m) and max(places_m) - min(places_m) <= SAME_PLACE_M
            return places_m[0] if is_row else None

        loaded = [tile for tile in self.tiles if not tile.reference]
        return common([tile.x_m for tile in loaded]), common([tile.y_m for tile in loaded])
