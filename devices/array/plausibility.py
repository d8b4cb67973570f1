"""Plausibility of readings, and of the time a conversion takes.

The protocol has no checksum, but a finished conversion can be read repeatedly and must stay the
same. A second read costs bus time, so it is used only where a reading jumps or the line is known to
be disturbed.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from devices.array.bus_recovery import BusMonitor
from devices.array.schedules import BusTiming, count_read_bits
from devices.array.tile import Scan, TileHealth, TileIo
from devices.chips.pressure_chip import Counts
from devices.clock import Clock
from devices.errors import NoAcknowledgeError
from devices.flags import TileFlag
from devices.frames import NOT_READ

DISTURBED_NS = 1_000_000_000
"""Time after a disturbed reading in which an unconfirmed jump is flagged."""

_IMPLAUSIBLE = int(TileFlag.IMPLAUSIBLE)


class PlausibilityCheck:
    """Plausibility check of the readings of an array's tiles."""

    def __init__(
        self, tile_io: TileIo, clock: Clock, health: Sequence[TileHealth], bus: BusMonitor
    ) -> None:
        self._tile_io = tile_io
        self._clock = clock
        self._health = health
        self._bus = bus
        self._known_silent_muxes: frozenset[int] = frozenset()
        self._disturbed_until_ns = clock.now_ns()

    @property
    def is_disturbed(self) -> bool:
        """True for a second after a flipped bit was detected."""
        return self._clock.now_ns() < self._disturbed_until_ns

    def check_reading(
        self,
        scan: Scan,
        tile: int,
        counts: Counts,
        *,
        with_temperature: bool,
        may_retry: bool,
    ) -> None:
        """Check a reading and store it in `scan`, flagged if it is implausible.

        Args:
            scan: frame that receives the reading.
            tile: index of the tile, which is still connected.
            counts: `pressure_raw` and `temperature_raw` as read.
            with_temperature: True if both were read.
            may_retry: True if there is time for another read.
        """
        health = self._health[tile]
        disturbed = self.is_disturbed
        jumps = health.is_jump(*counts)
        if may_retry and (jumps or (disturbed and health.is_jump(*counts, is_strict=True))):
            counts = self._read_majority(scan, tile, counts, with_temperature)
            jumps = health.is_jump(*counts)
        elif jumps and disturbed:
            # On a line with flipped bits an unconfirmed jump is not trusted.
            scan.add_flag(tile, TileFlag.IMPLAUSIBLE)
        scan.pressure_raw[tile], scan.temperature_raw[tile] = counts
        if impossible := self._tile_io.classify_counts(tile, counts):
            scan.add_flag(tile, impossible)
            health.mark_lost(self._clock.now_ns())
            scan.zero_reading_count += impossible == TileFlag.NOT_CONVERTED
            if scan.zero_reading_count == min(2, len(self._health)):
                self._bus.check_bus(scan)
            return
        if not self._tile_io.router.silent_addresses <= self._known_silent_muxes:
            self._mark_others_unverified(tile)
            self._verify_identity(scan, tile)
        elif jumps and health.is_far_jump(*counts):
            if may_retry:
                self._verify_identity(scan, tile)
            elif disturbed:
                scan.add_flag(tile, TileFlag.IMPLAUSIBLE)
        self._known_silent_muxes = frozenset(self._tile_io.router.silent_addresses)
        if not scan.tile_flags[tile] & _IMPLAUSIBLE:
            health.accept_reading(*counts, self._clock.now_ns())

    def _read_majority(
        self, scan: Scan, tile: int, counts: Counts, with_temperature: bool
    ) -> Counts:
        """Read again and return the majority: if two readings differ, a third one decides."""
        again = self._reread(scan, tile, with_temperature)
        if again == counts:
            return counts
        if again is None:
            if self._health[tile].is_jump(*counts):
                scan.add_flag(tile, TileFlag.IMPLAUSIBLE)
            return counts
        is_free_running, health = self._tile_io.are_free_running[tile], self._health[tile]
        if is_free_running and health.is_on_the_way(counts[0], again[0]):
            return counts  # a later conversion, which confirms the first reading
        third = self._reread(scan, tile, with_temperature)
        if third is not None and is_free_running and health.is_near(third[0], again[0]):
            return third  # conversions may have ended behind the readings before
        self._disturbed_until_ns = self._clock.now_ns() + DISTURBED_NS
        health.fault_counts["disturbed"] += 1
        scan.add_flag(tile, TileFlag.RETRIED)
        if third is None or third not in (counts, again):
            scan.add_flag(tile, TileFlag.IMPLAUSIBLE)
            return again
        return third

    def _reread(self, scan: Scan, tile: int, with_temperature: bool) -> Counts | None:
        """Select the tile and read the same conversion again; None without an answer."""
        counts = None
        self._tile_io.invalidate_muxes([tile])
        with scan.charge_retry(self._clock), suppress(NoAcknowledgeError):
            self._tile_io.connect_tile(tile)
            counts = self._tile_io.read_counts(tile, with_temperature)
        return counts

    def _verify_identity(self, scan: Scan, tile: int) -> None:
        """Verify by the registers that only this tile is connected; else flag it."""
        health = self._health[tile]
        is_own = False
        with scan.charge_retry(self._clock), suppress(NoAcknowledgeError):
            is_own = self._tile_io.is_set_up(tile)
        if not is_own:
            self._tile_io.router.invalidate_cache()
            scan.add_flag(tile, TileFlag.IMPLAUSIBLE)
            health.mark_lost(self._clock.now_ns())

    def _mark_others_unverified(self, tile: int) -> None:
        """Mark all other tiles as unverified: a mux that could not be closed may connect one."""
        for i, health in enumerate(self._health):
            if i != tile and health.is_present:
                health.mark_unverified(self._clock.now_ns())


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
        tile_io: TileIo,
        clock: Clock,
        health: Sequence[TileHealth],
        timing: BusTiming,
    ) -> None:
        self._measured_ns = tuple(round(wait_s * 1e9) for wait_s in timing.conversions_s)
        self.wait_ns = list(self._measured_ns)
        """Wait for each tile's conversion."""
        self._tile_io = tile_io
        self._clock = clock
        self._health = health
        reads = [
            chip.compute_read_bytes(tile.settings)[1]
            for tile, chip in zip(tile_io.tiles, tile_io.chips, strict=True)
        ]
        whole = replace(timing, read_bits=max(count_read_bits(*each) for each in reads))
        self._longest_ns = [
            chip.compute_conversion_ns(tile.settings)[1]
            for tile, chip in zip(tile_io.tiles, tile_io.chips, strict=True)
        ]
        self._wires_ns = round((whole.convert_s + whole.read_s) * 1e9)
        self._suspects: list[int] = []
        self._slow_due_ns = 0
        self._tries = 0

    def check_read_in_time(self, tile: int, last_counts: Counts) -> None:
        """Re-read a tile that was not restarted; suspect it if its counts have changed.

        Raises:
            I2cError: the tile does not answer.
        """
        if self._health[tile].is_slow or self._tile_io.chips[tile].has_status:
            return
        self._tile_io.connect_tile(tile)
        pressure_raw, temperature_raw = self._tile_io.read_counts(tile, with_temperature=True)
        if pressure_raw != last_counts[0] or last_counts[1] not in (temperature_raw, NOT_READ):
            self.queue_trial(tile)

    def queue_trial(self, tile: int) -> None:
        """Queue a tile for a trial: it may be read too early."""
        if self._tile_io.chips[tile].has_status:
            return  # a repeated reading is known as one
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
        early: list[Counts] = []
        for _ in range(tries):
            counts, in_time = self._convert_and_read(tile, self._measured_ns[tile])
            if not in_time:
                settled[-1] = self._convert_fully(tile)
                continue
            early.append(counts)
            if early[-1][1] != settled[-1][1]:
                self._mark_fast(tile)  # the temperature is loaded last: the conversion had finished
                return
            settled.append(self._convert_fully(tile))
            if len(early) >= _SAME_MAX and early == settled[: len(early)]:
                break  # no count has changed: the part is late
        if len({temperature_raw for _, temperature_raw in settled}) == 1 and any(
            counts != before for counts, before in zip(early, settled, strict=False)
        ):
            self._mark_fast(tile)  # with constant temperature the pressure decides
        elif len(early) >= _SAME_MAX and len(set(settled)) > 1 and not health.is_slow:
            # Conversions finish late. (A longer wait would not help a part that never finishes.)
            health.is_slow = True
            self.wait_ns[tile] = max(self._measured_ns[tile], self._longest_ns[tile])
        self._slow_due_ns = self._clock.now_ns() + SLOW_AUDIT_NS

    def _mark_fast(self, tile: int) -> None:
        self._health[tile].is_slow = False
        self.wait_ns[tile] = self._measured_ns[tile]

    def _convert_fully(self, tile: int) -> Counts:
        """Convert with the longest wait and return the counts."""
        return self._convert_and_read(tile, self._longest_ns[tile])[0]

    def _convert_and_read(self, tile: int, delay_ns: int) -> tuple[Counts, bool]:
        """Convert and read after `delay_ns`; return the counts and whether the read was on time.

        A busy machine may pause before either transfer, so all time off the wires counts as
        waiting. Returns only after the longest conversion time.
        """
        begin_ns = self._clock.now_ns()
        self._tile_io.start_conversions([tile])
        stop_ns = self._clock.now_ns()
        self._clock.sleep_until_ns(stop_ns + delay_ns)
        counts = self._tile_io.read_counts(tile, with_temperature=True)
        waited_ns = self._clock.now_ns() - begin_ns - self._wires_ns
        self._clock.sleep_until_ns(stop_ns + self._longest_ns[tile])
        return counts, waited_ns <= delay_ns + _HESITATION_NS
