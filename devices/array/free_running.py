"""Free-running tiles: each conversion is read once, at an instant estimated from the part's clock.

The part stores no times; the number of conversions gives the rate of its clock against ours.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from devices.array.schedules import ADDRESS_BITS, STORED_MAX, BusTiming, count_read_bits
from devices.array.tile import HELD_UP_NS, Scan, TileIo
from devices.chips.pressure_chip import Counts
from devices.clock import Clock
from devices.frames import NOT_READ

_EARLY = 0.05
"""Part of the period by which an end may come before its estimate."""
_NARROW = 0.1
"""Part of the period to which bounds must leave the end of a conversion to fix it."""
_COUNTED_MIN, _COUNTED_MAX = 200, 1000
"""Conversions between two fixed ends that give the period: a shorter time is less exact, a longer
one late when the period changes."""
_RATE_ERROR_MAX = 0.01
"""Largest relative error of a measured period; a larger one is a miscount."""
_PATIENCE = 1.1
"""Conversions in which one surely ends."""
_REFERENCES_MAX = 16
"""Readings of a reference beside a free-running part that are kept: of some frames."""


class ConversionClock:
    """Clock of a free-running part, followed by the number of its conversions in each read.

    Of n conversions since the read before, the first ended behind that one, the last before this
    one, and the next ends behind this one. Reads come at another interval than conversions, so now
    and then n is not one: then these bounds leave little room, and two such reads give the period.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = self._measured_ns = float(period_ns)
        self._end_ns = 0.0
        self._last_read_ns: tuple[int, int] | None = None
        self._fixed_ns: float | None = None
        self._counted = 0

    def set_end(self, end_ns: int) -> None:
        """Begin with the known end of a conversion, just before the next read."""
        self._end_ns = self._fixed_ns = end_ns
        self._last_read_ns, self._counted = None, 0

    def estimate_new(self, now_ns: int) -> int:
        """Estimate how many conversions a read finds now: at least one."""
        ended = int((now_ns - self._end_ns) / self._period_ns + _EARLY)
        return min(max(1, ended), STORED_MAX)

    def predict_ends_ns(self, until_ns: int) -> list[int]:
        """Predict the ends of the next conversions until an instant."""
        period_ns = self._period_ns
        count = min(int((until_ns - self._end_ns) // period_ns), STORED_MAX)
        return [round(self._end_ns + n * period_ns) for n in range(1, count + 1)]

    def count_conversions(self, count: int, begin_ns: int, end_ns: int) -> int:
        """Count the conversions in a read; return the estimated end of the last one.

        Args:
            count: conversions that ended since the last read.
            begin_ns: begin of this read.
            end_ns: its end.
        """
        last, self._last_read_ns = self._last_read_ns, (begin_ns, end_ns)
        if last is None:
            if self._fixed_ns is None:
                self._end_ns = begin_ns - self._period_ns / 2
            else:  # the known end is the last one's, unless time for others has passed
                self._counted = int((begin_ns - self._end_ns) // self._period_ns)
                self._end_ns += self._counted * self._period_ns
            return round(self._end_ns)
        low_ns = max(last[0] + (count - 1) * self._period_ns, begin_ns - self._period_ns)
        high_ns = min(end_ns, last[1] + count * self._period_ns)
        if count >= STORED_MAX or low_ns > high_ns:
            # Some are lost, or one is miscounted, and the period tells how many ended.
            ended = (begin_ns - self._end_ns) // self._period_ns
            self._end_ns += max(count if count >= STORED_MAX else 0, ended) * self._period_ns
            self._fixed_ns = None
            return round(self._end_ns)
        self._end_ns = min(max(self._end_ns + count * self._period_ns, low_ns), high_ns)
        self._counted += count
        if high_ns - low_ns < _NARROW * self._period_ns:
            self._end_ns = (low_ns + high_ns) / 2
            if self._fixed_ns is not None and self._counted >= _COUNTED_MIN:
                period_ns = (self._end_ns - self._fixed_ns) / self._counted
                if abs(period_ns / self._measured_ns - 1) < _RATE_ERROR_MAX:
                    self._period_ns = period_ns
                else:  # a miscount, unless the next one agrees
                    self._measured_ns, self._fixed_ns = period_ns, None
            if self._fixed_ns is None or self._counted >= _COUNTED_MAX:
                self._fixed_ns, self._counted = self._end_ns, 0
        return round(self._end_ns)


class FreeRunningTiles:
    """Reads of an array's free-running tiles.

    Args:
        tile_io: transfers to the tiles.
        clock: monotonic clock.
        timing: bus timing.
        sample_delay_ns: delay of each tile's sample behind the begin of its conversion.
        frame_ns: frame period.
    """

    def __init__(
        self,
        tile_io: TileIo,
        clock: Clock,
        timing: BusTiming,
        sample_delay_ns: tuple[int, ...],
        frame_ns: int,
    ) -> None:
        self._tile_io, self._clock = tile_io, clock
        self._sample_delay_ns = sample_delay_ns
        self._conversions_ns = tile_io.conversions_ns
        self.read_ns = [clock.now_ns()] * len(self._conversions_ns)
        """Begin of the last read of each tile."""
        # The part is read when its address has passed.
        self._bit_ns = 1e9 / timing.scl_hz
        self._address_ns = round(ADDRESS_BITS * self._bit_ns)
        self._has_unknown_phase = [True] * len(self._conversions_ns)
        # Before conversions are lost, but longer than a frame in which all phases are sought, else
        # these would follow one another.
        seeking_ns = 3 * (frame_ns + sum(self._conversions_ns))
        self._pause_ns = max((STORED_MAX - 4) * max(self._conversions_ns), seeking_ns)
        self._conversion_clocks = [ConversionClock(each_ns) for each_ns in self._conversions_ns]
        # Behind a filter the sample instant is some conversions ago.
        filtered = max(0, -sample_delay_ns[0] // self._conversions_ns[0])
        self._reference_readings: deque[tuple[int, float]] = deque(
            maxlen=_REFERENCES_MAX + 3 * filtered
        )

    def forget_phase(self, tile: int) -> None:
        """Forget the phase of a tile's conversions, which was absent; it is sought anew."""
        self._has_unknown_phase[tile] = True

    def follow_reference(self, read_n: Callable[[], float], until_ns: int) -> None:
        """Read the reference now, at each expected sample of the first tile, and at the end.

        The part's clock is known only after the read; so the force is interpolated then.
        """
        after_end_ns = self._sample_delay_ns[0] - self._conversions_ns[0]
        ends_ns = self._conversion_clocks[0].predict_ends_ns(until_ns - after_end_ns)
        for at_ns in (0, *(end_ns + after_end_ns for end_ns in ends_ns), until_ns):
            if not 0 < at_ns <= self._clock.now_ns():
                self._clock.sleep_until_ns(at_ns)
                begin_ns = self._clock.now_ns()
                force_n = read_n()
                if self._clock.now_ns() - begin_ns < HELD_UP_NS:
                    self._reference_readings.append((begin_ns, force_n))

    def is_held_up(self, since_ns: int) -> bool:
        """Return whether a read since an instant took so long that its sample has no instant."""
        return self._clock.now_ns() - since_ns > self._pause_ns

    def read_last_counts(self, scan: Scan, tile: int, with_temperature: bool) -> Counts:
        """Read a tile's last conversion, with its instant; `NOT_READ` if none has ended."""
        conversion_clock = self._conversion_clocks[tile]
        is_late = self._clock.now_ns() - self.read_ns[tile] > self._pause_ns
        if is_late or self._has_unknown_phase[tile]:
            self._find_phase(tile)
        begin_ns = self.read_ns[tile] = self._clock.now_ns()
        # One more than have ended since the last read, which tells that there is no more.
        at_once = conversion_clock.estimate_new(begin_ns) + 1
        pressures = self._tile_io.read_new_pressures(tile, at_once)
        # A read that was full is followed by another one, here an empty one.
        reads = 2 if pressures and len(pressures) % at_once == 0 else 1
        n_bytes = at_once * self._tile_io.chips[tile].bytes_per_conversion
        data_ns = round(reads * count_read_bits(n_bytes) * self._bit_ns) - self._address_ns
        ended_ns = conversion_clock.count_conversions(
            len(pressures), begin_ns + self._address_ns, self._clock.now_ns() - data_ns
        )
        scan.convert_stop_ns[tile] = ended_ns - self._conversions_ns[tile]
        if not pressures:
            return NOT_READ, NOT_READ
        if tile == 0 and self._reference_readings:
            scan.reference_ns = scan.convert_stop_ns[0] + self._sample_delay_ns[0]
            at_ns, forces_n = zip(*self._reference_readings, strict=True)
            if min(abs(scan.reference_ns - each_ns) for each_ns in at_ns) < self._pause_ns:
                scan.reference_n = float(np.interp(scan.reference_ns, at_ns, forces_n))
        temperature_raw = self._tile_io.read_temperature(tile) if with_temperature else NOT_READ
        return pressures[-1], temperature_raw

    def _find_phase(self, tile: int) -> None:
        """Wait for the end of a tile's conversion, which its status tells.

        It is sought once, for at most a conversion, so that a part that does not convert holds up
        the others no further.
        """
        # What has ended before is read, so that the next read finds the one that ends now.
        self._tile_io.read_new_pressures(tile, STORED_MAX)
        self._tile_io.has_new_counts(tile)
        since_ns = last_ns = read_ns = self._clock.now_ns()
        while not self._tile_io.has_new_counts(tile):
            if read_ns - since_ns > _PATIENCE * self._conversions_ns[tile]:
                break
            last_ns, read_ns = read_ns, self._clock.now_ns()
        self._conversion_clocks[tile].set_end((last_ns + read_ns) // 2 + self._address_ns)
        self._has_unknown_phase[tile] = False
