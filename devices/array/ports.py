"""The transfers of an array, tile by tile: connect what is meant, and nothing else, then ask."""

from __future__ import annotations

from collections.abc import Sequence

from devices.buses.i2c import I2cBus
from devices.chips.mpl115a2 import COUNTS_MAX, Mpl115a2
from devices.chips.tca9548a import MuxRouter
from devices.frames import NOT_READ, TileInfo


class TilePorts:
    """Tiles of one bus, addressed by their index. Every method raises `I2cError`."""

    def __init__(self, bus: I2cBus, tiles: Sequence[TileInfo]) -> None:
        self.tiles = tuple(tiles)
        self.router = MuxRouter(bus, [tile.mux for tile in tiles])
        self._chip = Mpl115a2(bus)
        self._masks: dict[tuple[int, ...], dict[int, int]] = {
            (i,): {tile.mux: 1 << tile.channel} for i, tile in enumerate(tiles)
        }

    def connect(self, tile: int) -> None:
        """Connect one tile and nothing else."""
        self.router.connect(self._masks[(tile,)])

    def convert(self, tiles: Sequence[int]) -> None:
        """Start a conversion in all of `tiles` with one CONVERT."""
        self.router.connect(self._masks_of(tuple(tiles)))
        self._chip.convert()

    def read(self, with_temperature: bool) -> tuple[int, int]:
        """`padc` and `tadc` (or `NOT_READ`) of the tile that is connected.

        At either end of its counts the pressure alone does not tell a part that is pressed too hard
        from a line that is stuck (hardware.md 8), so there the temperature is read as well.
        """
        if not with_temperature:
            padc = self._chip.read_padc()
            if padc not in (0, COUNTS_MAX):
                return padc, NOT_READ
        return self._chip.read_counts()

    def read_coefficients(self) -> bytes:
        """The eight coefficient bytes of the tile that is connected, read once."""
        return self._chip.read_coefficient_bytes()

    def read_coefficient_words(self, tile: int) -> tuple[int, int, int, int]:
        """Its coefficients, three times in agreement and plausible.

        Raises:
            TileSetupError: they are not.
        """
        return self._chip.read_coefficient_words(where=f"tile {self.tiles[tile].serial}")

    def forget(self, tiles: Sequence[int]) -> None:
        """What the muxes of these tiles connect is not known any more."""
        for mux in {self.tiles[i].mux for i in tiles}:
            self.router.forget(mux)

    def _masks_of(self, tiles: tuple[int, ...]) -> dict[int, int]:
        if tiles not in self._masks:
            masks: dict[int, int] = {}
            for i in tiles:
                tile = self.tiles[i]
                masks[tile.mux] = masks.get(tile.mux, 0) | 1 << tile.channel
            self._masks[tiles] = masks
        return self._masks[tiles]
