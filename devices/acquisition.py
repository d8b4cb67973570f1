"""Paced acquisition loop: batches of frames of an array, with the servo's position.

Clock and sleep are injected. A batch is yielded about every 25 ms. The consumer must be quick: the
loop does not wait for it, but counts and flags the slots that it missed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from devices.array.tile import Scan
from devices.array.tile_array import TileArray
from devices.chips.pressure_chips import Compensation, get_raw_type
from devices.clock import Clock, UtcAnchor
from devices.flags import FrameFlag, TileFlag
from devices.frames import (
    NO_SERVO_AGE,
    NO_SERVO_COUNTS,
    NOT_READ,
    FrameBatch,
    HeldTemperature,
    TileInfo,
    allocate_columns,
    hold_temperature,
)

BATCH_NS = 25_000_000
"""Duration of a batch. At 10 ms two fifths of a message would be header (performance.md)."""

STALL_SLOTS = 3
"""Slots missed at once from which a loop without a set rate counts as stalled and is flagged.

The loop may also be ahead of its slots by as many periods, which makes up for longer frames.
"""

SAMPLE_OFFSET_MAX_NS = 1_000_000_000
"""Distance from the frame's instant, beyond the time of a frame, from which a tile's sample is not
of this frame: the node was stopped meanwhile. A server accepts a minute (`storage.frame_rules`)."""
_OFFSET_END_NS = 60_000_000_000

_BATCH_FRAMES_MAX = 64  # rows allocated for a batch; more than any schedule takes in `BATCH_NS`
_AGE_MAX_US = 2**31 - 1  # the limit of int32


class ServoSource(Protocol):
    """Source of the newest servo position. The tile loop never waits for it."""

    def find_latest_position(self, t_mono_ns: int) -> tuple[int, int] | None:
        """Return the newest position known at `t_mono_ns`, in counts, and its sample instant.

        None before the first reading.
        """

    @property
    def stale_after_ns(self) -> int:
        """Age in ns above which a position is flagged as stale."""

    @property
    def is_turn_known(self) -> bool:
        """True if the number of whole turns in the last returned position is known."""


class AcquiredFrame(NamedTuple):
    """One new frame: a row of the columns of `FrameBatch`."""

    seq: int
    t_mono_ns: int
    t_ns: int
    servo_counts: int
    servo_age_us: int
    reference_force_n: float
    frame_flags: int
    pressure_raw: Sequence[int]
    temperature_raw: Sequence[int]
    sample_offset_us: Sequence[int]
    tile_flags: Sequence[int]


class FrameSink(Protocol):
    """Sink that receives every frame at once, before its batch is complete."""

    def write_frame(self, frame: AcquiredFrame) -> None:
        """Store one frame. It must be quick: the loop waits."""


class Acquisition:
    """Acquisition loop of one stream: `seq` counts from 0, `t_ns` is `t_mono_ns` plus an offset.

    The offset is fixed for the stream.

    Args:
        array: array to scan.
        tiles: its identified tiles.
        clock: virtual or real clock.
        anchor: UTC anchor of the stream.
        rate_hz: frame rate; 0: as fast as the schedule allows.
        expected_rate_hz: expected rate without a set rate, to count missed slots; 0: do not count.
        servo: source of the position stored with each frame.
        is_reidentified: the array was identified again in a running node; flagged in the first
            frame.
        frame_sink: stores frames while their batch is being filled. Readings out of range are
            flagged later, when a batch is complete (`RangeDetector`).
        lead_end_ns: as the attribute.
    """

    def __init__(
        self,
        array: TileArray,
        tiles: tuple[TileInfo, ...],
        clock: Clock,
        anchor: UtcAnchor,
        *,
        rate_hz: float = 0.0,
        expected_rate_hz: float = 0.0,
        servo: ServoSource | None = None,
        is_reidentified: bool = False,
        frame_sink: FrameSink | None = None,
        lead_end_ns: int | None = None,
    ) -> None:
        self.missed_slots = 0
        """Number of slots not sampled because the loop was late.

        The slots follow the set rate, else the expected rate.
        """
        self._array = array
        self._clock = clock
        self._anchor = anchor
        self._period_ns = round(1e9 / rate_hz) if rate_hz else 0
        self._expected_period_ns = round(1e9 / expected_rate_hz) if expected_rate_hz else 0
        frame_ns = max(self._period_ns, array.frame_ns)
        self._offset_max_ns = min(SAMPLE_OFFSET_MAX_NS + frame_ns, _OFFSET_END_NS)
        self._servo = servo
        self._is_reidentified = is_reidentified
        self._frame_sink = frame_sink
        self.lead_end_ns = lead_end_ns
        """End of the lead of an emulated load: earlier frames are flagged; None: no lead."""
        self._raw_type = get_raw_type(tiles)
        self._range_detector = RangeDetector(tiles)
        self._next_seq = 0
        self._last_t_mono_ns = 0
        array.begin_stream()

    def acquire_batches(self, should_stop: Callable[[], bool]) -> Iterator[FrameBatch]:
        """Acquire frames until `should_stop()`, evaluated before every frame, returns True.

        Yields:
            Batches of at least one frame; the last one may be short.

        Raises:
            BusMisuseError: as for `TileArray.scan_frame`; other faults are flags.
        """
        slot_ns = self._clock.now_ns()
        while not should_stop():
            columns = allocate_columns(_BATCH_FRAMES_MAX, len(self._array.tiles), self._raw_type)
            row = 0
            batch_end_ns = self._clock.now_ns() + BATCH_NS
            while (
                row < _BATCH_FRAMES_MAX
                and self._clock.now_ns() < batch_end_ns
                and not should_stop()
            ):
                frame_flags = 0
                if self._period_ns:
                    late = max(0, self._clock.now_ns() - slot_ns) // self._period_ns
                    if late:
                        self.missed_slots += late
                        slot_ns += late * self._period_ns
                        frame_flags |= FrameFlag.OVERRUN
                    self._clock.sleep_until_ns(slot_ns)
                    slot_ns += self._period_ns
                elif self._expected_period_ns:
                    now_ns = self._clock.now_ns()
                    late = max(0, now_ns - slot_ns) // self._expected_period_ns
                    self.missed_slots += late
                    if late >= STALL_SLOTS:
                        frame_flags |= FrameFlag.OVERRUN
                    # A loop that is a little late in each frame misses slots, too.
                    slot_ns += (late + 1) * self._expected_period_ns
                    slot_ns = min(slot_ns, now_ns + STALL_SLOTS * self._expected_period_ns)
                self._store_frame(columns, row, self._array.scan_frame(), frame_flags)
                row += 1
            if row:
                yield self._make_batch(columns, row)

    def _store_frame(
        self, columns: dict[str, np.ndarray], row: int, scan: Scan, frame_flags: int
    ) -> None:
        samples_ns = [
            stop_ns + delay_ns
            for stop_ns, delay_ns in zip(
                scan.convert_stop_ns, self._array.sample_delay_ns, strict=True
            )
        ]
        first = next(
            (i for i, pressure_raw in enumerate(scan.pressure_raw) if pressure_raw != NOT_READ), 0
        )
        # Monotonic: the sample of a tile that was skipped in this frame is older.
        t_mono_ns = max(samples_ns[first], self._last_t_mono_ns + 1)
        self._last_t_mono_ns = t_mono_ns
        if self._is_reidentified:
            frame_flags |= FrameFlag.NEW_ARRAY_INFO
            self._is_reidentified = False
        if scan.bus_fault:
            frame_flags |= FrameFlag.BUS_FAULT
        if self.lead_end_ns is not None and t_mono_ns < self.lead_end_ns:
            frame_flags |= FrameFlag.LEAD
        servo_counts, servo_age_us = NO_SERVO_COUNTS, NO_SERVO_AGE
        if self._servo is not None:
            reading = self._servo.find_latest_position(t_mono_ns)
            if reading is not None:
                servo_counts, age_ns = reading[0], t_mono_ns - reading[1]
                servo_age_us = min(age_ns // 1000, _AGE_MAX_US)
                if not self._servo.is_turn_known:
                    frame_flags |= FrameFlag.SERVO_TURN_UNKNOWN
            if reading is None or age_ns > self._servo.stale_after_ns:
                frame_flags |= FrameFlag.SERVO_STALE
        offsets_ns = [sample_ns - t_mono_ns for sample_ns in samples_ns]
        if max(offsets_ns) > self._offset_max_ns or min(offsets_ns) < -self._offset_max_ns:
            self._discard_far_samples(scan, offsets_ns)
        # Positional for speed: this runs for every frame.
        frame = AcquiredFrame(
            self._next_seq,
            t_mono_ns,
            t_mono_ns + self._anchor.offset_ns,
            servo_counts,
            servo_age_us,
            scan.reference_n,
            frame_flags,
            scan.pressure_raw,
            scan.temperature_raw,
            [offset_ns // 1000 for offset_ns in offsets_ns],
            scan.tile_flags,
        )
        for name, value in zip(AcquiredFrame._fields, frame, strict=True):
            columns[name][row] = value
        if self._frame_sink is not None:
            self._frame_sink.write_frame(frame)
        self._next_seq += 1

    def _discard_far_samples(self, scan: Scan, offsets_ns: list[int]) -> None:
        """Discard samples far from the frame's instant, and set their offsets to zero."""
        for tile, offset_ns in enumerate(offsets_ns):
            if abs(offset_ns) > self._offset_max_ns:
                offsets_ns[tile] = 0
                if scan.pressure_raw[tile] != NOT_READ:
                    scan.discard_reading(tile)
                    self._array.health[tile].count_faults(TileFlag.NOT_CONVERTED)

    def _make_batch(self, columns: dict[str, np.ndarray], rows: int) -> FrameBatch:
        batch = FrameBatch(**{name: column[:rows] for name, column in columns.items()})
        self._range_detector.flag_out_of_range(batch)
        return batch


class RangeDetector:
    """Detector of readings outside the chips' pressure range, for batches in order.

    Raw counts stay as read. Beyond its range the count of a chip that wraps, as an MPL115A2, falls
    through zero to near full count (hardware.md 1.3), so both ends are out of range.
    """

    def __init__(self, tiles: tuple[TileInfo, ...]) -> None:
        self._compensation = Compensation(tiles)
        self._temperature: HeldTemperature | None = None

    def flag_out_of_range(self, batch: FrameBatch) -> None:
        """Set the flag `OVER_RANGE` in the batch, in place."""
        held, self._temperature = hold_temperature(batch, self._temperature)
        chips = self._compensation
        kpa = chips.compute_usable_kpa(held)
        at_wrap = (batch.pressure_raw <= 1) & (chips.wrap_counts > 0)
        outside = (kpa > chips.max_kpa) | (kpa < chips.min_kpa) | at_wrap
        batch.tile_flags[outside & ~np.isnan(kpa)] |= np.uint8(TileFlag.OVER_RANGE)
