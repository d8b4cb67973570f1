"""How long each part is waited for, and whether it still keeps the time it was measured to need."""

from __future__ import annotations

from collections.abc import Sequence

from devices.clock import Clock
from devices.frames import NOT_READ
from devices.health import TileHealth
from devices.mpl115a2 import CONVERSION_MAX_NS
from devices.tile_ports import TilePorts

SLOW_AUDIT_NS = 500_000_000
"""A part that was found to be slow is tried so often, to notice when it no longer is."""

_TRIES = 3


class ConversionWatch:
    """Waits of all tiles, and what keeps them true.

    A reading that is taken too early is that of the conversion before. If the part is started anew
    right after it, nothing ever finishes, and its words stand still, which is noticed. If it has
    time to finish until the next CONVERT, its words change from frame to frame like any other, one
    frame late, and betray nothing: so in some frames one tile is read again before that CONVERT,
    and has to be the same. A suspect is tried: the same conversion is read after the measured time
    and after the longest that the data sheet allows.
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
        self._suspects: list[int] = []
        self._slow_due_ns = 0
        self._tries = 0

    def look_again(self, tile: int, words: tuple[int, int]) -> None:
        """Read a tile again that gave `words` and was not started since.

        Raises:
            I2cError: it does not answer.
        """
        if self._health[tile].slow:
            return
        self._ports.connect(tile)
        padc, tadc = self._ports.read(with_temperature=True)
        if padc != words[0] or words[1] not in (tadc, NOT_READ):
            self.suspect(tile)

    def suspect(self, tile: int) -> None:
        """This tile's words may be too old."""
        if tile not in self._suspects and not self._health[tile].slow:
            self._suspects.append(tile)

    def to_try(self) -> int | None:
        """A tile whose conversion should be tried now; None if there is none."""
        if self._suspects:
            return self._suspects.pop(0)
        now_ns = self._clock.now_ns()
        slow = [i for i, health in enumerate(self._health) if health.slow and health.present]
        if slow and now_ns >= self._slow_due_ns:
            self._slow_due_ns = now_ns + SLOW_AUDIT_NS
            self._tries += 1
            return slow[self._tries % len(slow)]
        return None

    def try_conversion(self, tile: int) -> None:
        """Find out whether a part keeps its time, and wait for it accordingly from now on.

        Its conversion has to be started anew afterwards.

        Raises:
            I2cError: it does not answer.
        """
        health = self._health[tile]
        # A disturbed bit looks like a late conversion, but not twice; two results are equal by
        # chance, but not three times.
        late = sum(self._is_late(tile) for _ in range(_TRIES))
        if late > 1 and not health.slow:
            health.slow = True
            self.wait_ns[tile] = max(self._measured_ns[tile], CONVERSION_MAX_NS)
            self._slow_due_ns = self._clock.now_ns() + SLOW_AUDIT_NS
        elif not late and health.slow:
            health.slow = False
            self.wait_ns[tile] = self._measured_ns[tile]

    def _is_late(self, tile: int) -> bool:
        """Does a reading after the measured time differ from a later one of the same conversion?"""
        self._ports.convert([tile])
        stop_ns = self._clock.now_ns()
        self._clock.sleep_until_ns(stop_ns + self._measured_ns[tile])
        early = self._ports.read(with_temperature=True)
        self._clock.sleep_until_ns(stop_ns + CONVERSION_MAX_NS)
        return self._ports.read(with_temperature=True) != early
