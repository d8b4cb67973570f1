"""Tile input and output: select exactly the addressed tiles, then convert or read.

A `Scan` collects the readings and flags of one frame, and its remaining retry budget.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from devices.buses.i2c import I2cBus
from devices.chips.mpl115a2 import COUNTS_MAX, Mpl115a2
from devices.chips.tca9548a import MuxRouter
from devices.clock import Clock
from devices.errors import BusFaultError
from devices.flags import TileFlag
from devices.frames import NOT_READ, TileInfo


class TileIo:
    """Transfers to the tiles of one bus, by tile index. Every method may raise `I2cError`."""

    def __init__(self, bus: I2cBus, tiles: Sequence[TileInfo]) -> None:
        self.tiles = tuple(tiles)
        self.router = MuxRouter(bus, [tile.mux for tile in tiles])
        self._chip = Mpl115a2(bus)
        self._masks: dict[tuple[int, ...], dict[int, int]] = {
            (i,): {tile.mux: 1 << tile.channel} for i, tile in enumerate(tiles)
        }

    def connect_tile(self, tile: int) -> None:
        """Connect one tile and nothing else."""
        self.router.connect_channels(self._masks[(tile,)])

    def start_conversions(self, tiles: Sequence[int]) -> None:
        """Start a conversion in all of `tiles` with one CONVERT."""
        self.router.connect_channels(self._masks_of(tuple(tiles)))
        self._chip.start_conversion()

    def read_counts(self, with_temperature: bool) -> tuple[int, int]:
        """Return `pressure_raw` and `temperature_raw` (or `NOT_READ`) of the connected tile.

        At either end of the counts pressure alone cannot tell an overloaded part from a stuck line
        (hardware.md 8), so the temperature is read as well.
        """
        if not with_temperature:
            pressure_raw = self._chip.read_padc()
            if pressure_raw not in (0, COUNTS_MAX):
                return pressure_raw, NOT_READ
        return self._chip.read_counts()

    def read_coefficient_bytes(self) -> bytes:
        """Read the eight coefficient bytes of the connected tile, once."""
        return self._chip.read_coefficient_bytes()

    def read_coefficient_words(self, tile: int) -> tuple[int, int, int, int]:
        """Read a tile's coefficients three times and check them.

        Raises:
            TileSetupError: the readings differ or are implausible.
        """
        return self._chip.read_coefficient_words(where=f"tile {self.tiles[tile].serial}")

    def invalidate_muxes(self, tiles: Sequence[int]) -> None:
        """Discard the cached state of the muxes of these tiles."""
        for mux in {self.tiles[i].mux for i in tiles}:
            self.router.invalidate_cache(mux)

    def _masks_of(self, tiles: tuple[int, ...]) -> dict[int, int]:
        if tiles not in self._masks:
            masks: dict[int, int] = {}
            for i in tiles:
                tile = self.tiles[i]
                masks[tile.mux] = masks.get(tile.mux, 0) | 1 << tile.channel
            self._masks[tiles] = masks
        return self._masks[tiles]


_BUS_FAULTS_MAX = 2  # each may cost the adapter's timeout, 30 ms


@dataclass
class Scan:
    """Readings and flags of one frame, one entry per tile.

    Attributes:
        pressure_raw: 0 to 1023, `NOT_READ` where not read.
        temperature_raw: likewise.
        convert_stop_ns: CLOCK_MONOTONIC at the STOP of the CONVERT of each sample.
        tile_flags: `TileFlag` bits.
        budget_ns: time left in this frame for retries of all tiles together.
        bus_fault: the bus itself failed, not one tile.
        reference_n: the calibration rig's force in newtons; NaN without.
    """

    pressure_raw: list[int]
    temperature_raw: list[int]
    convert_stop_ns: list[int]
    tile_flags: list[int]
    budget_ns: int = 0
    bus_fault: bool = False
    reference_n: float = float("nan")
    reference_ns: int | None = field(default=None, repr=False)
    zero_reading_count: int = field(default=0, repr=False)
    """Number of tiles that read as zeros only."""
    _bus_faults: int = field(default=0, repr=False)

    @classmethod
    def empty(cls, tile_count: int, begin_ns: int, budget_ns: int) -> Scan:
        """Create a frame without readings."""
        return cls(
            [NOT_READ] * tile_count,
            [NOT_READ] * tile_count,
            [begin_ns] * tile_count,
            [0] * tile_count,
            budget_ns,
        )

    @property
    def is_abandoned(self) -> bool:
        """True if the bus failed so often that the rest of the frame is skipped."""
        return self._bus_faults >= _BUS_FAULTS_MAX

    def count_bus_fault(self, *, abandons_frame: bool = False) -> None:
        """Count a bus fault; abandon the frame after two, or at once if `abandons_frame`."""
        self.bus_fault = True
        self._bus_faults += _BUS_FAULTS_MAX if abandons_frame else 1

    @contextmanager
    def charge_retry(self, clock: Clock) -> Iterator[None]:
        """Context manager: charge the block's time to the retry budget; count a bus fault."""
        begin_ns = clock.now_ns()
        try:
            yield
        except BusFaultError:
            self.count_bus_fault()
        self.budget_ns -= clock.now_ns() - begin_ns

    def add_flag(self, tile: int, status: TileFlag | int) -> None:
        """Add a flag to a tile."""
        self.tile_flags[tile] |= status
