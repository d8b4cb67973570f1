"""Reconnection of lost tiles: probe with a backoff, and verify the identity by coefficients.

The eight factory coefficients are the only identity of a part. A part that answers with other
coefficients is another part.
"""

from __future__ import annotations

from collections.abc import Sequence

from devices.array.health import TileHealth
from devices.array.ports import Scan, TilePorts
from devices.clock import Clock
from devices.errors import NoAcknowledgeError, TileSetupError
from devices.frames import TileStatus


class Search:
    """Prober of the lost tiles of an array, with a backoff for each."""

    def __init__(self, ports: TilePorts, clock: Clock, health: Sequence[TileHealth]) -> None:
        self._ports = ports
        self._clock = clock
        self._health = health

    def note_absence(self, scan: Scan, tile: int) -> None:
        """Flag a lost tile in a frame."""
        replaced = self._health[tile].replaced
        scan.flag(tile, TileStatus.IMPLAUSIBLE if replaced else TileStatus.NO_ANSWER)

    def look_for(self, scan: Scan, tile: int) -> None:
        """Probe a lost tile if a probe is due; a tile that is back is sampled in the next frame."""
        self.note_absence(scan, tile)
        health = self._health[tile]
        if not health.is_probe_due(self._clock.now_ns()):
            return
        with scan.second_attempt(self._clock):
            try:
                if self._is_itself(tile):
                    health.find()
                    return
            except TileSetupError:
                scan.flag(tile, TileStatus.IMPLAUSIBLE)
            except NoAcknowledgeError:
                self._ports.forget([tile])
            health.lose(self._clock.now_ns())

    def _is_itself(self, tile: int) -> bool:
        """Return whether the coefficients are the tile's own; mark another part as replaced."""
        health = self._health[tile]
        self._ports.connect(tile)
        if self._ports.read_coefficients() == health.coefficient_bytes:
            health.replaced = False
            return True
        # A flipped bit, in the reading or the select before it, must not look like another part.
        words = set()
        for _ in range(2):
            self._ports.router.forget()
            self._ports.connect(tile)
            words.add(self._ports.read_coefficient_words(tile))
        if words == {health.coefficient_words}:
            health.replaced = False
            return True
        # Three equal, plausible readings of other coefficients: another part.
        health.replaced = len(words) == 1 and not self._ports.router.silent
        return False
