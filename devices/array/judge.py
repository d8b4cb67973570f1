"""Plausibility check of readings; doubtful ones are read again before they are passed on.

The protocol has no checksum, but a finished conversion can be read repeatedly and must stay the
same. A second read costs bus time, so it is used only where a reading jumps or the line is known to
be disturbed.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from devices.array.bus_watch import BusWatch
from devices.array.health import TileHealth, is_impossible
from devices.array.ports import Scan, TilePorts
from devices.clock import Clock
from devices.errors import NoAcknowledgeError
from devices.frames import TileStatus

DISTURBED_NS = 1_000_000_000
"""Time after a disturbed reading in which an unconfirmed jump is flagged."""

_IMPLAUSIBLE = int(TileStatus.IMPLAUSIBLE)


class Judge:
    """Plausibility check of the readings of an array's tiles."""

    def __init__(
        self, ports: TilePorts, clock: Clock, health: Sequence[TileHealth], bus: BusWatch
    ) -> None:
        self._ports = ports
        self._clock = clock
        self._health = health
        self._bus = bus
        self._silent: frozenset[int] = frozenset()
        self._disturbed_until_ns = clock.now_ns()

    @property
    def is_disturbed(self) -> bool:
        """True for a second after a flipped bit was detected."""
        return self._clock.now_ns() < self._disturbed_until_ns

    def judge(
        self,
        scan: Scan,
        tile: int,
        words: tuple[int, int],
        *,
        with_temperature: bool,
        may_ask: bool,
    ) -> None:
        """Check a reading and store it in `scan`, flagged if it is implausible.

        Args:
            scan: frame that receives the reading.
            tile: index of the tile, which is still connected.
            words: `padc` and `tadc` as read.
            with_temperature: True if both were read.
            may_ask: True if there is time for another read.
        """
        health = self._health[tile]
        disturbed = self.is_disturbed
        jumps = health.jumps(*words)
        if may_ask and (jumps or (disturbed and health.jumps(*words, strictly=True))):
            words = self._confirmed(scan, tile, words, with_temperature)
            jumps = health.jumps(*words)
        elif jumps and disturbed:
            # On a line with flipped bits an unconfirmed jump is not trusted.
            scan.flag(tile, TileStatus.IMPLAUSIBLE)
        scan.padc[tile], scan.tadc[tile] = words
        if impossible := is_impossible(*words):
            scan.flag(tile, impossible)
            health.lose(self._clock.now_ns())
            scan.zeros += impossible == TileStatus.NOT_CONVERTED
            if scan.zeros == min(2, len(self._health)):
                self._bus.look(scan)
            return
        if not self._ports.router.silent <= self._silent:
            self._doubt_all_but(tile)
            self._make_sure(scan, tile)
        elif jumps and health.may_be_another(*words):
            if may_ask:
                self._make_sure(scan, tile)
            elif disturbed:
                scan.flag(tile, TileStatus.IMPLAUSIBLE)
        self._silent = frozenset(self._ports.router.silent)
        if not scan.status[tile] & _IMPLAUSIBLE:
            health.believe(*words, self._clock.now_ns())

    def _confirmed(
        self, scan: Scan, tile: int, words: tuple[int, int], with_temperature: bool
    ) -> tuple[int, int]:
        """Read again and return the majority: if two readings differ, a third one decides."""
        again = self._again(scan, tile, with_temperature)
        if again == words:
            return words
        if again is None:
            if self._health[tile].jumps(*words):
                scan.flag(tile, TileStatus.IMPLAUSIBLE)
            return words
        third = self._again(scan, tile, with_temperature)
        self._disturbed_until_ns = self._clock.now_ns() + DISTURBED_NS
        self._health[tile].counts["disturbed"] += 1
        scan.flag(tile, TileStatus.RETRIED)
        if third is None or third not in (words, again):
            scan.flag(tile, TileStatus.IMPLAUSIBLE)
            return again
        return third

    def _again(self, scan: Scan, tile: int, with_temperature: bool) -> tuple[int, int] | None:
        """Select the tile and read the same conversion again; None without an answer."""
        words = None
        self._ports.forget([tile])
        with scan.second_attempt(self._clock), suppress(NoAcknowledgeError):
            self._ports.connect(tile)
            words = self._ports.read(with_temperature)
        return words

    def _make_sure(self, scan: Scan, tile: int) -> None:
        """Verify by the coefficients that only this tile is connected; else flag it."""
        health = self._health[tile]
        found = b""
        with scan.second_attempt(self._clock), suppress(NoAcknowledgeError):
            found = self._ports.read_coefficients()
        if found != health.coefficient_bytes:
            self._ports.router.forget()
            scan.flag(tile, TileStatus.IMPLAUSIBLE)
            health.lose(self._clock.now_ns())

    def _doubt_all_but(self, tile: int) -> None:
        """Mark all other tiles as unverified: a mux that could not be closed may connect one."""
        for i, health in enumerate(self._health):
            if i != tile and health.present:
                health.doubt(self._clock.now_ns())
