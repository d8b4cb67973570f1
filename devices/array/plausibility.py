"""Plausibility check of readings; doubtful ones are read again before they are passed on.

The protocol has no checksum, but a finished conversion can be read repeatedly and must stay the
same. A second read costs bus time, so it is used only where a reading jumps or the line is known to
be disturbed.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from devices.array.bus_monitor import BusMonitor
from devices.array.tile_health import TileHealth, classify_impossible_counts
from devices.array.tile_io import Scan, TileIo
from devices.clock import Clock
from devices.errors import NoAcknowledgeError
from devices.flags import TileFlag

DISTURBED_NS = 1_000_000_000
"""Time after a disturbed reading in which an unconfirmed jump is flagged."""

_IMPLAUSIBLE = int(TileFlag.IMPLAUSIBLE)


class PlausibilityCheck:
    """Plausibility check of the readings of an array's tiles."""

    def __init__(
        self, ports: TileIo, clock: Clock, health: Sequence[TileHealth], bus: BusMonitor
    ) -> None:
        self._tile_io = ports
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
        counts: tuple[int, int],
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
        if impossible := classify_impossible_counts(*counts):
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
        self, scan: Scan, tile: int, words: tuple[int, int], with_temperature: bool
    ) -> tuple[int, int]:
        """Read again and return the majority: if two readings differ, a third one decides."""
        again = self._reread(scan, tile, with_temperature)
        if again == words:
            return words
        if again is None:
            if self._health[tile].is_jump(*words):
                scan.add_flag(tile, TileFlag.IMPLAUSIBLE)
            return words
        third = self._reread(scan, tile, with_temperature)
        self._disturbed_until_ns = self._clock.now_ns() + DISTURBED_NS
        self._health[tile].fault_counts["disturbed"] += 1
        scan.add_flag(tile, TileFlag.RETRIED)
        if third is None or third not in (words, again):
            scan.add_flag(tile, TileFlag.IMPLAUSIBLE)
            return again
        return third

    def _reread(self, scan: Scan, tile: int, with_temperature: bool) -> tuple[int, int] | None:
        """Select the tile and read the same conversion again; None without an answer."""
        words = None
        self._tile_io.invalidate_muxes([tile])
        with scan.charge_retry(self._clock), suppress(NoAcknowledgeError):
            self._tile_io.connect_tile(tile)
            words = self._tile_io.read_counts(with_temperature)
        return words

    def _verify_identity(self, scan: Scan, tile: int) -> None:
        """Verify by the coefficients that only this tile is connected; else flag it."""
        health = self._health[tile]
        found = b""
        with scan.charge_retry(self._clock), suppress(NoAcknowledgeError):
            found = self._tile_io.read_coefficient_bytes()
        if found != health.coefficient_bytes:
            self._tile_io.router.invalidate_cache()
            scan.add_flag(tile, TileFlag.IMPLAUSIBLE)
            health.mark_lost(self._clock.now_ns())

    def _mark_others_unverified(self, tile: int) -> None:
        """Mark all other tiles as unverified: a mux that could not be closed may connect one."""
        for i, health in enumerate(self._health):
            if i != tile and health.is_present:
                health.mark_unverified(self._clock.now_ns())
