"""How long each part is waited for, and whether it still keeps the time it was measured to need."""

from __future__ import annotations

from collections.abc import Sequence

from devices.clock import Clock
from devices.health import TileHealth
from devices.mpl115a2 import CONVERSION_MAX_NS
from devices.tile_ports import TilePorts

AUDIT_NS = 1_000_000_000
"""So often the muxes' control registers are read back, and one part's conversion is tried."""
SLOW_AUDIT_NS = 500_000_000
"""The same while a part is slow, to notice when it no longer is."""

_TRIES = 3


class ConversionWatch:
    """Waits of all tiles, and the audit that keeps them true.

    A reading that was taken too early is that of the conversion before: in a schedule that always
    waits equally long it changes from frame to frame like any other and betrays nothing. So one
    part after another is asked for the same conversion twice, after its measured time and after the
    longest that the data sheet allows; both have to be the same.
    """

    def __init__(
        self,
        ports: TilePorts,
        clock: Clock,
        health: Sequence[TileHealth],
        measured_ns: Sequence[int],
    ) -> None:
        self.wait_ns = list(measured_ns)
        """How long to wait for each tile's conversion."""
        self._ports = ports
        self._clock = clock
        self._health = health
        self._measured_ns = tuple(measured_ns)
        self._due_ns = clock.now_ns() + AUDIT_NS
        self._audits = 0

    def is_due(self, now_ns: int) -> bool:
        """Is it time for an audit?"""
        return now_ns >= self._due_ns

    def audit(self) -> int | None:
        """Look at the muxes and at one tile; which one, as its conversion has to be started anew.

        Raises:
            I2cError: the bus or the tile does not answer.
        """
        present = [i for i, health in enumerate(self._health) if health.present]
        slow = [i for i in present if self._health[i].slow]
        self._due_ns = self._clock.now_ns() + (SLOW_AUDIT_NS if slow else AUDIT_NS)
        self._ports.router.audit()
        if not present:
            return None
        self._audits += 1
        tile = (slow or present)[self._audits % len(slow or present)]
        # A disturbed bit looks like a late conversion once, but not again.
        late = [self._is_late(tile) for _ in range(_TRIES)] if self._is_late(tile) else []
        if late and all(late):
            self.slow_down(tile)
        elif self._health[tile].slow and not any(late):
            self._health[tile].slow = False
            self.wait_ns[tile] = self._measured_ns[tile]
        return tile

    def slow_down(self, tile: int) -> None:
        """Allow a part all the time that the data sheet does."""
        if not self._health[tile].slow:
            self._health[tile].slow = True
            self.wait_ns[tile] = max(self._measured_ns[tile], CONVERSION_MAX_NS)
            self._due_ns = min(self._due_ns, self._clock.now_ns() + SLOW_AUDIT_NS)

    def _is_late(self, tile: int) -> bool:
        """Does a reading after the measured time differ from a later one of the same conversion?"""
        self._ports.convert([tile])
        stop_ns = self._clock.now_ns()
        self._clock.sleep_until_ns(stop_ns + self._measured_ns[tile])
        early = self._ports.read(with_temperature=True)
        self._clock.sleep_until_ns(stop_ns + CONVERSION_MAX_NS)
        return self._ports.read(with_temperature=True) != early
