"""The transfers of an array, tile by tile: connect what is meant, and nothing else, then ask.

A `Scan` is one frame while it is taken: what they gave so far, and what may still be spent.
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
from devices.frames import NOT_READ, TileInfo, TileStatus


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
        """Forget what the muxes of these tiles connect."""
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


_BUS_FAULTS_MAX = 2  # each may cost the adapter's time-out, 30 ms


@dataclass
class Scan:
    """What one frame's transfers gave, one entry per tile.

    Attributes:
        padc: 0 to 1023, `NOT_READ` where not read.
        tadc: likewise.
        convert_stop_ns: CLOCK_MONOTONIC at the STOP of the CONVERT that each sample comes from.
        status: `TileStatus` bits.
        budget_ns: time left in this frame for second attempts of all tiles together.
        bus_fault: the bus itself failed, not one tile.
        reference_n: the calibration rig's force in newtons; NaN without.
    """

    padc: list[int]
    tadc: list[int]
    convert_stop_ns: list[int]
    status: list[int]
    budget_ns: int = 0
    bus_fault: bool = False
    reference_n: float = float("nan")
    reference_ns: int | None = field(default=None, repr=False)
    zeros: int = field(default=0, repr=False)
    """Tiles that read as nothing but zeros."""
    _bus_faults: int = field(default=0, repr=False)

    @classmethod
    def blank(cls, tiles: int, begin_ns: int, budget_ns: int) -> Scan:
        """A frame without any reading."""
        return cls(
            [NOT_READ] * tiles, [NOT_READ] * tiles, [begin_ns] * tiles, [0] * tiles, budget_ns
        )

    @property
    def given_up(self) -> bool:
        """The bus has failed, so the rest of the frame is not worth its time-outs."""
        return self._bus_faults >= _BUS_FAULTS_MAX

    def note_bus_fault(self, *, for_good: bool = False) -> None:
        """The bus failed once; after the second time, or at once, the frame is given up."""
        self.bus_fault = True
        self._bus_faults += _BUS_FAULTS_MAX if for_good else 1

    @contextmanager
    def second_attempt(self, clock: Clock) -> Iterator[None]:
        """Take the block's time from the budget; a fault of the bus in it ends it and is noted."""
        begin_ns = clock.now_ns()
        try:
            yield
        except BusFaultError:
            self.note_bus_fault()
        self.budget_ns -= clock.now_ns() - begin_ns

    def flag(self, tile: int, status: TileStatus | int) -> None:
        """Add to a tile's status."""
        self.status[tile] |= status
