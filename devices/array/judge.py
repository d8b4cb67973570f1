"""Is a reading to be believed? What looks doubtful is asked for again, before it is passed on.

The protocol has no checksum, but a finished conversion can be read as often as one likes, and must
be the same each time. That is dear on the wire, so it is asked for only where a reading is far from
those before, or where the line is known to be disturbed.
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
"""After a disturbed reading, a jump that cannot be checked is refused for this long."""

_IMPLAUSIBLE = int(TileStatus.IMPLAUSIBLE)


class Judge:
    """Judges the readings of an array's tiles."""

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
        """Was a flipped bit seen not long ago?"""
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
        """Note a reading in `scan`, flagged if it is not to be believed.

        Args:
            scan: the frame.
            tile: which tile was read and is connected.
            words: `padc` and `tadc` as read.
            with_temperature: were both read?
            may_ask: is there time to ask again?
        """
        health = self._health[tile]
        disturbed = self.is_disturbed
        jumps = health.jumps(*words)
        if may_ask and (jumps or (disturbed and health.jumps(*words, strictly=True))):
            words = self._confirmed(scan, tile, words, with_temperature)
            jumps = health.jumps(*words)
        elif jumps and disturbed:
            # On a line with flipped bits a reading that cannot be checked is refused.
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
        """The reading that came twice: if two differ, one was disturbed, a third tells which."""
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
        """The same conversion, selected and read once more; None if it does not answer."""
        words = None
        self._ports.forget([tile])
        with scan.second_attempt(self._clock), suppress(NoAcknowledgeError):
            self._ports.connect(tile)
            words = self._ports.read(with_temperature)
        return words

    def _make_sure(self, scan: Scan, tile: int) -> None:
        """Check by the coefficients that this tile, and no other, is connected."""
        health = self._health[tile]
        found = b""
        with scan.second_attempt(self._clock), suppress(NoAcknowledgeError):
            found = self._ports.read_coefficients()
        if found != health.coefficient_bytes:
            self._ports.router.forget()
            scan.flag(tile, TileStatus.IMPLAUSIBLE)
            health.lose(self._clock.now_ns())

    def _doubt_all_but(self, tile: int) -> None:
        """A mux that could not be closed may still connect a tile, which would answer too."""
        for i, health in enumerate(self._health):
            if i != tile and health.present:
                health.doubt(self._clock.now_ns())
