"""An array of tiles behind multiplexers, and the schedules by which one frame of it is taken.

A schedule is one function: it runs the transfers of one frame and notes in a `Scan` what came back.
Rates on the wire are those of `bus_budget.py` in the design's companion (hardware.md 4): with four
tiles at 400 kHz and a wait of 1.6 ms `sequential` takes 132 frames/s, `simultaneous` 395.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_

from devices.clock import Clock
from devices.errors import (
    BusMisuseError,
    BusSetupError,
    I2cError,
    NoAcknowledgeError,
    TileSetupError,
)
from devices.frames import NOT_READ, TileInfo, TileStatus
from devices.i2c import I2cBus
from devices.mpl115a2 import (
    CONVERSION_TYPICAL_NS,
    COUNTS_MAX,
    SAMPLE_PART_OF_CONVERSION,
    Mpl115a2,
)
from devices.scene import ScheduleName, TileScene
from devices.tca9548a import MuxRouter

STALE_AFTER = 24
"""Identical readings in a row after which a part counts as stale. With the noise of a real part
(1.3 counts of pressure, half a count of temperature) two readings agree by chance in about one of
ten, so 24 in a row do not happen; with noise correlated over 10 ms still less than once a year."""


@dataclass
class Scan:
    """What one frame's transfers gave, one entry per tile."""

    padc: list[int]
    tadc: list[int]
    convert_stop_ns: list[int]
    """CLOCK_MONOTONIC at the STOP of each tile's CONVERT."""
    status: list[int]
    bus_fault: bool = False


Schedule = Callable[["TileArray"], Scan]


class TileArray:
    """Tiles of one bus, addressed by their index in the frame."""

    def __init__(
        self,
        bus: I2cBus,
        tiles: Sequence[TileScene],
        clock: Clock,
        *,
        schedule: ScheduleName,
        wait_ms: float,
    ) -> None:
        self.tiles = tuple(tiles)
        self.clock = clock
        self.wait_ns = round(wait_ms * 1e6)
        self.chip = Mpl115a2(bus)
        self.router = MuxRouter(bus, (tile.mux for tile in tiles))
        self.all_channels = {
            mux: reduce(or_, (1 << tile.channel for tile in tiles if tile.mux == mux))
            for mux in self.router.addresses
        }
        self.schedule_name = schedule
        self._schedule = SCHEDULES[schedule]
        self._last_words = [(-1, -1)] * len(tiles)
        self._repeats = [0] * len(tiles)
        self._answered = [True] * len(tiles)

    def identify(self) -> tuple[TileInfo, ...]:
        """Find every tile, one channel at a time, and read its coefficients.

        One at a time, because in a broadcast the acknowledge is a wired AND: a missing tile does
        not show (hardware.md 2).

        Raises:
            TileSetupError: a tile or its mux does not answer, or its coefficients are implausible.
            BusFaultError: the bus itself fails.
        """
        return tuple(self._identify(tile) for tile in self.tiles)

    def _identify(self, tile: TileScene) -> TileInfo:
        where = f"tile {tile.serial} (mux 0x{tile.mux:02x} channel {tile.channel})"
        try:
            self.router.connect_only(tile.mux, tile.channel)
            words = self.chip.read_coefficient_words(where=where)
        except NoAcknowledgeError as error:
            raise TileSetupError(
                f"does not answer: {error}",
                where=where,
                remedy="Plug it in, or take it out of the scene file",
            ) from error
        return TileInfo(
            serial=tile.serial,
            mux=tile.mux,
            channel=tile.channel,
            coefficient_words=words,
            x_m=tile.x_m,
            y_m=tile.y_m,
            z_m=tile.z_m,
            reference=tile.reference,
            conversion_ms=CONVERSION_TYPICAL_NS / 1e6,
        )

    def scan(self) -> Scan:
        """Take one frame. A fault of a tile or the bus is a status bit in it, never an exception.

        Raises:
            BusMisuseError: the adapter refuses our transfers: a bug, not a fault of the field.
            BusSetupError: the bus went away.
        """
        begin_ns = self.clock.now_ns()
        scan = self._schedule(self)
        if all(padc == NOT_READ for padc in scan.padc):
            # Nobody answers, so nothing was waited for: do not run the faster for it.
            self.clock.sleep_until_ns(begin_ns + self.wait_ns)
        self._note_stale(scan)
        return scan

    @property
    def sample_delay_ns(self) -> int:
        """From the STOP of a CONVERT to the instant the pressure is taken to be sampled."""
        return CONVERSION_TYPICAL_NS // SAMPLE_PART_OF_CONVERSION

    def blank_scan(self) -> Scan:
        """A scan in which nothing has been read."""
        n = len(self.tiles)
        return Scan([NOT_READ] * n, [NOT_READ] * n, [self.clock.now_ns()] * n, [0] * n)

    def attempt(self, scan: Scan, tiles: Sequence[int], transfers: Callable[[], None]) -> bool:
        """Run `transfers` for `tiles`, once more if they fail, and note the outcome in `scan`.

        Only tiles that answered in the previous frame are worth the second attempt: one bad plug
        must not cost the others their rate at every frame.
        """
        for attempt in range(2):
            try:
                transfers()
            except (BusMisuseError, BusSetupError):
                raise
            except I2cError as error:
                self.router.forget()
                # A silent tile is that tile's fault; anything else is the bus's.
                scan.bus_fault |= not isinstance(error, NoAcknowledgeError)
                if not any(self._answered[i] for i in tiles):
                    break
                continue
            if attempt:
                for i in tiles:
                    scan.status[i] |= TileStatus.RETRIED
            return True
        for i in tiles:
            scan.status[i] |= TileStatus.NO_ANSWER
        return False

    def read_into(self, scan: Scan, tile: int) -> None:
        """Read the finished conversion of the one tile that is connected."""
        padc, tadc = self.chip.read_counts()
        scan.padc[tile] = padc
        scan.tadc[tile] = tadc
        if padc == tadc == 0:
            scan.status[tile] |= TileStatus.NOT_CONVERTED
        elif padc == tadc == COUNTS_MAX:
            scan.status[tile] |= TileStatus.IMPLAUSIBLE

    def _note_stale(self, scan: Scan) -> None:
        for i, words in enumerate(zip(scan.padc, scan.tadc, strict=True)):
            answered = words[0] != NOT_READ
            self._answered[i] = answered
            self._repeats[i] = self._repeats[i] + 1 if words == self._last_words[i] else 0
            self._last_words[i] = words
            if answered and self._repeats[i] >= STALE_AFTER:
                scan.status[i] |= TileStatus.STALE


def sequential(array: TileArray) -> Scan:
    """Tile by tile: select, convert, wait, read. The slow and plain reference."""
    scan = array.blank_scan()
    for i, tile in enumerate(array.tiles):

        def transfers(i: int = i, tile: TileScene = tile) -> None:
            array.router.connect_only(tile.mux, tile.channel)
            array.chip.convert()
            scan.convert_stop_ns[i] = array.clock.now_ns()
            array.clock.sleep_until_ns(scan.convert_stop_ns[i] + array.wait_ns)
            array.read_into(scan, i)

        array.attempt(scan, [i], transfers)
    return scan


def simultaneous(array: TileArray) -> Scan:
    """Open all channels, one CONVERT for all tiles, wait once, then read each: no skew."""
    scan = array.blank_scan()
    everyone = range(len(array.tiles))

    def broadcast() -> None:
        array.router.connect(array.all_channels)
        array.chip.convert()

    if not array.attempt(scan, everyone, broadcast):
        return scan
    convert_stop_ns = array.clock.now_ns()
    scan.convert_stop_ns = [convert_stop_ns] * len(array.tiles)

    for i, tile in enumerate(array.tiles):

        def transfers(i: int = i, tile: TileScene = tile) -> None:
            # The first select is hidden in the wait.
            array.router.connect_only(tile.mux, tile.channel)
            array.clock.sleep_until_ns(convert_stop_ns + array.wait_ns)
            array.read_into(scan, i)

        array.attempt(scan, [i], transfers)
    return scan


SCHEDULES: Mapping[ScheduleName, Schedule] = {
    "sequential": sequential,
    "simultaneous": simultaneous,
}
