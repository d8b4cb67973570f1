"""Reconnection of lost tiles: probe with a backoff, and verify the identity by coefficients.

The eight factory coefficients are the only identity of a part. A part that answers with other
coefficients is another part.
"""

from __future__ import annotations

from collections.abc import Sequence

from devices.array.tile_health import TileHealth
from devices.array.tile_io import Scan, TileIo
from devices.clock import Clock
from devices.errors import NoAcknowledgeError, TileSetupError
from devices.flags import TileFlag


class TileReconnector:
    """Prober of the lost tiles of an array, with a backoff for each."""

    def __init__(self, ports: TileIo, clock: Clock, health: Sequence[TileHealth]) -> None:
        self._tile_io = ports
        self._clock = clock
        self._health = health

    def flag_absence(self, scan: Scan, tile: int) -> None:
        """Flag a lost tile in a frame."""
        replaced = self._health[tile].is_replaced
        scan.add_flag(tile, TileFlag.IMPLAUSIBLE if replaced else TileFlag.NO_ANSWER)

    def probe_if_due(self, scan: Scan, tile: int) -> None:
        """Probe a lost tile if a probe is due; a tile that is back is sampled in the next frame."""
        self.flag_absence(scan, tile)
        health = self._health[tile]
        if not health.is_probe_due(self._clock.now_ns()):
            return
        with scan.charge_retry(self._clock):
            try:
                if self._verify_identity(tile):
                    health.mark_present()
                    return
            except TileSetupError:
                scan.add_flag(tile, TileFlag.IMPLAUSIBLE)
            except NoAcknowledgeError:
                self._tile_io.invalidate_muxes([tile])
            health.mark_lost(self._clock.now_ns())

    def _verify_identity(self, tile: int) -> bool:
        """Return whether the coefficients are the tile's own; mark another part as replaced."""
        health = self._health[tile]
        self._tile_io.connect_tile(tile)
        if self._tile_io.read_coefficient_bytes() == health.coefficient_bytes:
            health.is_replaced = False
            return True
        # A flipped bit, in the reading or the select before it, must not look like another part.
        words = set()
        for _ in range(2):
            self._tile_io.router.invalidate_cache()
            self._tile_io.connect_tile(tile)
            words.add(self._tile_io.read_coefficient_words(tile))
        if words == {health.coefficient_words}:
            health.is_replaced = False
            return True
        # Three equal, plausible readings of other coefficients: another part.
        health.is_replaced = len(words) == 1 and not self._tile_io.router.silent_addresses
        return False
