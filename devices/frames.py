"""Raw data of a node: frames in batches, their flags, and the description of their array.

Driver, disk, wire and estimator all exchange a `FrameBatch`: contiguous numpy columns, time first.
Counts stay as read. A missing count is `NOT_READ`, an unknown number is NaN, never zero and never
the last value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from devices.arrays import ArrayRecord, Times
from devices.flags import TileFlag
from devices.types import (
    MODELS_MAX,
    RATE_HZ_MIN,
    TILES_MAX,
    Identifier,
    Metres,
    OffsetNs,
    Seq,
    StrictModel,
    TMonoNs,
    UInt16,
)

NOT_READ = 65535
"""Count of a reading that is missing. No kind of chip gives it in use."""
NO_SERVO_COUNTS = -(2**31)
NO_SERVO_AGE = -1
RawCounts = np.uint16 | np.uint32
"""Type of the counts of an array: the chips' widest."""
SAME_PLACE_M = 1e-6
"""Tiles that differ by no more along an axis stand in one row."""


@dataclass(frozen=True)
class FrameBatch(ArrayRecord):
    """Batch of n frames of an array, in time order.

    Attributes:
        seq: uint64[n], number of the frame in its stream, from 0.
        t_mono_ns: int64[n], CLOCK_MONOTONIC at the sample instant of the frame's first tile.
        t_ns: int64[n], the same instant in UTC ns since 1970 (`t_mono_ns` + the stream's anchor).
        pressure_raw: uint16 or uint32[n, tiles], raw pressure counts of the chips; `NOT_READ` where
            not read.
        temperature_raw: likewise, of temperature, in the same type.
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
    pressure_raw: npt.NDArray[RawCounts]
    temperature_raw: npt.NDArray[RawCounts]
    sample_offset_us: npt.NDArray[np.int32]
    servo_counts: npt.NDArray[np.int32]
    servo_age_us: npt.NDArray[np.int32]
    tile_flags: npt.NDArray[np.uint8]
    frame_flags: npt.NDArray[np.uint8]
    reference_force_n: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        by_tile = self.pressure_raw.shape
        by_frame = by_tile[:1]
        for name, (dtype, per_tile) in get_frame_columns(self.pressure_raw.dtype).items():
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
"""Data type of every column, and whether it has one value per tile; for chips of up to 16 bits."""

RAW_COLUMNS = ("pressure_raw", "temperature_raw")
"""Columns of counts, of an unsigned type that holds the counts of all chips of the array."""
_WIDE = FRAME_COLUMNS | dict.fromkeys(RAW_COLUMNS, (np.dtype(np.uint32), True))


def get_frame_columns(raw_type: np.dtype[Any]) -> dict[str, tuple[np.dtype[Any], bool]]:
    """Return `FRAME_COLUMNS` for counts of this type, uint16 or uint32."""
    return _WIDE if raw_type == np.uint32 else FRAME_COLUMNS


def allocate_columns(
    frame_count: int, tile_count: int, raw_type: np.dtype[Any]
) -> dict[str, np.ndarray]:
    """Allocate zeroed columns for n frames with counts of this type."""
    return {
        name: np.zeros((frame_count, tile_count) if per_tile else frame_count, dtype)
        for name, (dtype, per_tile) in get_frame_columns(raw_type).items()
    }


class Edge(NamedTuple):
    """Edge on a sync line, between the frames of a stream."""

    number: Seq
    """Number since the node was started, from 1; dropped ones are counted, too."""
    t_mono_ns: TMonoNs
    """CLOCK_MONOTONIC, as the kernel stamped it."""
    is_rising: bool


HOLD_MAX_NS = 1_000_000_000
"""Longest hold of a temperature; an older one is not used. A pressure cannot be computed without,
and an array may read it in every k-th frame only; but in a second it changes by less than matters
(0.04 kPa per count of an MPL115A2)."""


@dataclass(frozen=True)
class HeldTemperature:
    """Last temperature of each tile and its instant; `NOT_READ` for none.

    Attributes:
        temperature_raw: counts[tiles].
        t_mono_ns: int64[tiles].
    """

    temperature_raw: npt.NDArray[RawCounts]
    t_mono_ns: Times


def hold_temperature(
    frames: FrameBatch, held: HeldTemperature | None = None
) -> tuple[FrameBatch, HeldTemperature]:
    """Fill in missing temperatures with the last one of each tile, if it is not too old.

    Stored frames keep `NOT_READ`, so the age of a temperature is always known. The result does not
    depend on the split of a stream into batches, if `held` is passed on.

    Args:
        frames: n frames in order.
        held: state returned for the previous frames.

    Returns:
        The filled frames, and the state for the next ones.
    """
    tiles = frames.tile_count
    if held is None:
        held = HeldTemperature(
            np.full(tiles, NOT_READ, frames.temperature_raw.dtype), np.zeros(tiles, dtype=np.int64)
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


ChipRegisters = Annotated[tuple[UInt16, ...], Field(max_length=16)]
"""Words that a chip is identified by (MPL115A2: a0, b1, b2, c12); opaque to all but its driver."""
_Factor = Annotated[float, Field(ge=-1e6, le=1e6)]


class TileInfo(StrictModel):
    """Tile as identified on the bus at start-up."""

    serial: Identifier
    mux: Annotated[int, Field(ge=0, le=0x7F)]
    channel: Annotated[int, Field(ge=0, le=7)]
    chip: Identifier
    """Kind of its pressure chip (`devices.chips.pressure_chips`)."""
    address: Annotated[int, Field(ge=0, le=0x7F)]
    registers: ChipRegisters
    settings: ChipRegisters = ()
    """Words that a chip is set up by; an MPL115A2 has none."""
    x_m: Metres
    y_m: Metres
    z_m: Metres
    reference: bool
    conversion_ms: Annotated[float, Field(gt=0, le=1000)]
    """Conversion time as measured, else the data sheet's typical one."""


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
