"""Monitor of conversion times: detects parts that have become slower than measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from devices.array.tile_health import TileHealth
from devices.array.tile_io import TileIo
from devices.array.timing_budget import BusTiming
from devices.chips.mpl115a2 import CONVERSION_MAX_NS
from devices.clock import Clock
from devices.frames import NOT_READ

SLOW_AUDIT_NS = 500_000_000
"""Interval of trials of a slow part, to detect that it is fast again."""

_HESITATION_NS = 100_000
"""Delay of a read beyond plan from which its trial proves nothing."""

_TRIES, _SLOW_TRIES, _SAME_MAX = 8, 2, 3
"""Conversions in a trial of a suspect and of a slow part, and equal ones that end it. A pair of
readings of a healthy part has equal temperatures in every second case, eight pairs in one of 250.
Trials of a slow part are shorter: its return to normal is not urgent."""


class ConversionMonitor:
    """Conversion waits of all tiles, and the checks that keep them valid.

    A read that is too early returns the previous conversion. If the part restarts right after it,
    no conversion ever finishes, and its counts stand still, which is flagged as stale. If the part
    has time to finish before the next CONVERT, its counts change from frame to frame, one frame
    late, and look healthy: so in some frames one tile is read again before that CONVERT, and its
    counts have to be the same. For a suspect tile a trial checks the measured conversion time.
    """

    def __init__(
        self,
        ports: TileIo,
        clock: Clock,
        health: Sequence[TileHealth],
        timing: BusTiming,
    ) -> None:
        self._measured_ns = tuple(round(wait_s * 1e9) for wait_s in timing.conversions_s)
        self.wait_ns = list(self._measured_ns)
        """Wait for each tile's conversion."""
        self._tile_io = ports
        self._clock = clock
        self._health = health
        whole = replace(timing, bytes_per_read=4.0)
        self._wires_ns = round((whole.convert_s + whole.read_s) * 1e9)
        self._suspects: list[int] = []
        self._slow_due_ns = 0
        self._tries = 0

    def check_read_in_time(self, tile: int, last_counts: tuple[int, int]) -> None:
        """Re-read a tile that gave `words` and was not restarted; suspect it if they changed.

        Raises:
            I2cError: the tile does not answer.
        """
        if self._health[tile].is_slow:
            return
        self._tile_io.connect_tile(tile)
        pressure_raw, temperature_raw = self._tile_io.read_counts(with_temperature=True)
        if pressure_raw != last_counts[0] or last_counts[1] not in (temperature_raw, NOT_READ):
            self.queue_trial(tile)

    def queue_trial(self, tile: int) -> None:
        """Queue a tile for a trial: it may be read too early."""
        if tile not in self._suspects and not self._health[tile].is_slow:
            self._suspects.append(tile)

    def pop_due_trial(self) -> int | None:
        """Return the next tile whose trial is due; None: no trial."""
        if self._suspects:
            return self._suspects.pop(0)
        now_ns = self._clock.now_ns()
        slow = [i for i, health in enumerate(self._health) if health.is_slow and health.is_present]
        if slow and now_ns >= self._slow_due_ns:
            self._slow_due_ns = now_ns + SLOW_AUDIT_NS
            self._tries += 1
            return slow[self._tries % len(slow)]
        return None

    def test_conversion_time(self, tile: int) -> None:
        """Test whether a part converts within its measured time, and set its wait accordingly.

        As in the self-test there is one read per CONVERT, because a read may abort an unfinished
        conversion. The caller has to restart the tile afterwards.

        Raises:
            I2cError: the tile does not answer.
        """
        health = self._health[tile]
        tries = _SLOW_TRIES if health.is_slow else _TRIES
        settled = [self._convert_fully(tile)]
        early: list[tuple[int, int]] = []
        for _ in range(tries):
            words, in_time = self._convert_and_read(tile, self._measured_ns[tile])
            if not in_time:
                settled[-1] = self._convert_fully(tile)
                continue
            early.append(words)
            if early[-1][1] != settled[-1][1]:
                self._mark_fast(tile)  # the temperature is loaded last: the conversion had finished
                return
            settled.append(self._convert_fully(tile))
            if len(early) >= _SAME_MAX and early == settled[: len(early)]:
                break  # no count has changed: the part is late
        if len({temperature_raw for _, temperature_raw in settled}) == 1 and any(
            words != before for words, before in zip(early, settled, strict=False)
        ):
            self._mark_fast(tile)  # with constant temperature the pressure decides
        elif len(early) >= _SAME_MAX and len(set(settled)) > 1 and not health.is_slow:
            # Conversions finish late. (A longer wait would not help a part that never finishes.)
            health.is_slow = True
            self.wait_ns[tile] = max(self._measured_ns[tile], CONVERSION_MAX_NS)
        self._slow_due_ns = self._clock.now_ns() + SLOW_AUDIT_NS

    def _mark_fast(self, tile: int) -> None:
        self._health[tile].is_slow = False
        self.wait_ns[tile] = self._measured_ns[tile]

    def _convert_fully(self, tile: int) -> tuple[int, int]:
        """Convert with the longest wait and return the counts."""
        return self._convert_and_read(tile, CONVERSION_MAX_NS)[0]

    def _convert_and_read(self, tile: int, delay_ns: int) -> tuple[tuple[int, int], bool]:
        """Convert and read after `delay_ns`; return the counts and whether the read was on time.

        A busy machine may pause before either transfer, so all time off the wires counts as
        waiting. Returns only after the longest conversion time.
        """
        begin_ns = self._clock.now_ns()
        self._tile_io.start_conversions([tile])
        stop_ns = self._clock.now_ns()
        self._clock.sleep_until_ns(stop_ns + delay_ns)
        words = self._tile_io.read_counts(with_temperature=True)
        waited_ns = self._clock.now_ns() - begin_ns - self._wires_ns
        self._clock.sleep_until_ns(stop_ns + CONVERSION_MAX_NS)
        return words, waited_ns <= delay_ns + _HESITATION_NS
