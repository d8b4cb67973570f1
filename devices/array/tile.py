"""Tile behind a multiplexer: its selection and transfers, and its health by its readings.

A `Scan` collects the readings and flags of one frame, and its remaining retry budget.

The protocol has no checksum, and a part may have no status bit (MPL115A2: hardware.md 1.1, 8).
Evidence of a fault: counts that no working part gives, a jump that a second read does not confirm,
readings that never change, and other registers than at start-up.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from devices.buses.i2c import I2cBus
from devices.chips.pressure_chip import Counts, Registers
from devices.chips.pressure_chips import get_chip
from devices.chips.tca9548a import MuxRouter
from devices.clock import Clock
from devices.errors import BusFaultError, NoAcknowledgeError
from devices.flags import TileFlag
from devices.frames import NOT_READ, TileInfo


class TileIo:
    """Transfers to the tiles of one bus, by tile index. Every method may raise `I2cError`."""

    def __init__(self, bus: I2cBus, tiles: Sequence[TileInfo]) -> None:
        self.tiles = tuple(tiles)
        self.router = MuxRouter(bus, [tile.mux for tile in tiles])
        self.chips = tuple(get_chip(tile.chip) for tile in tiles)
        # A driver for each kind and address: it starts all connected parts of these at once.
        drivers = {
            (tile.chip, tile.address): chip.make_driver(bus, tile.address)
            for tile, chip in zip(tiles, self.chips, strict=True)
        }
        self._drivers = [drivers[tile.chip, tile.address] for tile in tiles]
        self.are_free_running = tuple(
            chip.is_free_running(tile.settings)
            for tile, chip in zip(tiles, self.chips, strict=True)
        )
        self.conversions_ns = tuple(round(tile.conversion_ms * 1e6) for tile in tiles)
        self.silent_tiles: tuple[int, ...] = ()
        """Tiles whose address nobody acknowledged at the last start of conversions."""
        self._masks: dict[tuple[int, ...], dict[int, int]] = {
            (i,): {tile.mux: 1 << tile.channel} for i, tile in enumerate(tiles)
        }

    def connect_tile(self, tile: int) -> None:
        """Connect one tile and nothing else."""
        self.router.connect_channels(self._masks[(tile,)])

    def start_conversions(self, tiles: Sequence[int]) -> None:
        """Start a conversion in all of `tiles` at once; free-running ones start theirs.

        A silent kind of part does not keep the others from starting.
        """
        self.silent_tiles = ()
        started = [i for i in tiles if not self.are_free_running[i]]
        if not started:
            return
        self.router.connect_channels(self._masks_of(tuple(started)))
        silence: NoAcknowledgeError | None = None
        for driver in dict.fromkeys(self._drivers[i] for i in started):
            try:
                driver.start_conversion()
            except NoAcknowledgeError as error:
                silence = error
                self.silent_tiles += tuple(i for i in started if self._drivers[i] is driver)
        if silence is not None:
            raise silence

    def read_counts(self, tile: int, with_temperature: bool) -> Counts:
        """Return `pressure_raw` and `temperature_raw` (or `NOT_READ`) of a connected tile."""
        driver = self._drivers[tile]
        if not with_temperature and (pressure_raw := driver.read_pressure()) is not None:
            return pressure_raw, NOT_READ
        return driver.read_counts()

    def classify_counts(self, tile: int, counts: Counts) -> int:
        """Return the flag of counts just read that no working part gives; 0 for others."""
        return self._drivers[tile].classify_counts(*counts)

    def start_up(self, tile: int) -> None:
        """Prepare a connected tile after power-up."""
        self._drivers[tile].start_up(self.tiles[tile].settings)

    def is_set_up(self, tile: int) -> bool:
        """Return whether a quick look finds a connected tile's part, and its settings."""
        return self._drivers[tile].is_set_up_as(
            self.tiles[tile].registers, self.tiles[tile].settings
        )

    def has_new_counts(self, tile: int) -> bool:
        """Return whether a connected tile ended a conversion since this was last asked."""
        return self._drivers[tile].has_new_counts()

    def read_new_pressures(self, tile: int, at_once: int) -> list[int]:
        """Read the pressures of a connected free-running tile since this was last called."""
        return self._drivers[tile].read_new_pressures(at_once)

    def read_temperature(self, tile: int) -> int:
        """Read the temperature of a connected tile alone."""
        return self._drivers[tile].read_temperature()

    def read_registers(self, tile: int) -> Registers:
        """Read the registers of a connected tile, once."""
        return self._drivers[tile].read_registers()

    def identify(self, tile: int) -> Registers:
        """Read the registers of a connected tile repeatedly and check them.

        Raises:
            TileSetupError: the readings differ, or are no such chip's.
        """
        return self._drivers[tile].identify(where=f"tile {self.tiles[tile].serial}")

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


HELD_UP_NS = 100_000_000
"""Length of a transfer from which the instants in it are not known: more than a hesitation of a
busy machine. A node may be stopped in it, or its driver may hang."""

_BUS_FAULTS_MAX = 2  # each may cost the adapter's timeout, 30 ms


@dataclass
class Scan:
    """Readings and flags of one frame, one entry per tile.

    Attributes:
        pressure_raw: counts, `NOT_READ` where not read.
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

    def discard_reading(self, tile: int) -> None:
        """Discard a reading that is not of this frame, or of an unknown instant.

        The reference force is that of the first tile's instant.
        """
        self.pressure_raw[tile] = self.temperature_raw[tile] = NOT_READ
        if tile == 0:
            self.reference_n = float("nan")
        self.add_flag(tile, TileFlag.NOT_CONVERTED)

    def add_flag(self, tile: int, status: TileFlag | int) -> None:
        """Add a flag to a tile."""
        self.tile_flags[tile] |= status


STALE_SCORE = 20
"""Score from which a tile is stale: 2 for each reading equal to the previous one, 1 if only the
pressure was read; 0 after another one. One in nine readings of a healthy MPL115A2, and fewer of a
finer chip, equals its neighbour, so ten in a row occur once in 10^9; with noise that is correlated
over 10 ms once in 10^6."""

_TRIAL_EVERY = 2048  # every two seconds at 500 frames a second
_TEMPERATURE_MAX_NS = 500_000_000  # half the hold of `devices.frames`
_FIRST_PROBE_NS = 2_000_000  # a loose plug is back within a few milliseconds
_PROBES_NS = 1_000_000_000  # longest interval between probes
_RECENT = 3  # a single outlier does not move the median of three


class TileHealth:
    """Recent readings and known faults of one tile."""

    def __init__(self, info: TileInfo) -> None:
        self.fault_counts: Counter[str] = Counter()
        """Fault counts, by the name of the flag."""
        self.registers = info.registers
        self.is_present = True
        """True if the tile answers and is verified. Else its registers are checked first."""
        self.is_replaced = False
        """True if another part answers in its place."""
        self.is_slow = False
        """True if conversions take longer than measured at start-up."""
        chip = get_chip(info.chip)
        law = chip.make_law(info.registers)
        count_kpa = abs(float(law.compute_kpa_per_count(chip.temperature_raw_usual)))
        self._jump = chip.jump_kpa / count_kpa
        self._far_jump = chip.far_jump_kpa / count_kpa
        self._jump_temperature_counts = chip.jump_temperature_counts
        self._recent: deque[int] = deque(maxlen=_RECENT)
        self._temperature_raw: int | None = None
        self._temperature_ns = 0
        self._last_counts = (NOT_READ, NOT_READ)
        self._stale_score = 0
        self._probe_due_ns = 0
        self._probe_wait_ns = 0

    # Presence

    def mark_lost(self, now_ns: int) -> None:
        """Mark the tile as lost (silent, or impossible counts); probe it with a backoff."""
        if self.is_present:
            self.mark_unverified(now_ns)
        else:
            self._probe_due_ns = now_ns + self._probe_wait_ns
            self._probe_wait_ns = min(2 * self._probe_wait_ns, _PROBES_NS)

    def mark_unverified(self, now_ns: int) -> None:
        """Mark the tile as unverified: another part may answer, so check its registers."""
        self.is_present = False
        self._probe_due_ns = now_ns
        self._probe_wait_ns = _FIRST_PROBE_NS
        self._recent.clear()
        self._temperature_raw = None
        self._stale_score = 0

    def is_probe_due(self, now_ns: int) -> bool:
        """Return whether the next probe of a lost tile is due."""
        return now_ns >= self._probe_due_ns

    def count_faults(self, status: int) -> None:
        """Count the faults in a frame's flags."""
        self.fault_counts.update(bit.name.lower() for bit in TileFlag(status) if bit.name)

    def mark_present(self) -> None:
        """Mark the tile as present again, as the same part."""
        self.is_present = True

    # Readings

    def is_temperature_due(self, now_ns: int) -> bool:
        """Return whether the last temperature is missing or too old."""
        return self._temperature_raw is None or now_ns - self._temperature_ns > _TEMPERATURE_MAX_NS

    def is_jump(self, pressure_raw: int, temperature_raw: int, *, is_strict: bool = False) -> bool:
        """Return whether a reading is far from the previous ones, or has too few to compare with.

        Strictly: half the distance is too far, for a line that is known to be disturbed.
        """
        if len(self._recent) < _RECENT:
            return True
        limit = self._jump / 2 if is_strict else self._jump
        return abs(pressure_raw - self._median()) > limit or self._is_hot(temperature_raw)

    def is_near(self, pressure_raw: int, other_raw: int) -> bool:
        """Return whether two pressures differ by less than a jump."""
        return abs(pressure_raw - other_raw) <= self._jump

    def is_on_the_way(self, pressure_raw: int, later_raw: int) -> bool:
        """Return whether a reading lies between the previous ones and a later one, or near."""
        before = self._median() if len(self._recent) == _RECENT else later_raw
        low, high = sorted((before, later_raw))
        return low - self._jump <= pressure_raw <= high + self._jump

    def is_far_jump(self, pressure_raw: int, temperature_raw: int) -> bool:
        """Return whether a confirmed reading may come from another tile, or from two at once."""
        if len(self._recent) < _RECENT:
            return False
        return abs(pressure_raw - self._median()) > self._far_jump or self._is_hot(temperature_raw)

    def accept_reading(self, pressure_raw: int, temperature_raw: int, now_ns: int) -> None:
        """Add an accepted reading to the recent ones."""
        self._recent.append(pressure_raw)
        if temperature_raw != NOT_READ:
            self._temperature_raw = temperature_raw
            self._temperature_ns = now_ns

    def update_staleness(self, pressure_raw: int, temperature_raw: int) -> bool:
        """Update the score with a frame's reading; return whether the tile is stale."""
        if pressure_raw == NOT_READ:
            return False
        same = pressure_raw == self._last_counts[0] and (
            temperature_raw == NOT_READ or self._last_counts[1] in (temperature_raw, NOT_READ)
        )
        if same:
            self._stale_score += 1 if temperature_raw == NOT_READ else 2
        else:
            self._stale_score = 0
        self._last_counts = (
            pressure_raw,
            self._last_counts[1] if same and temperature_raw == NOT_READ else temperature_raw,
        )
        return self.has_stale_readings

    @property
    def has_stale_readings(self) -> bool:
        """True if the readings are stale."""
        return self._stale_score >= STALE_SCORE

    @property
    def is_trial_due(self) -> bool:
        """True if the conversion time of a stale tile should be tested: at first, then at times."""
        return 0 <= (self._stale_score - STALE_SCORE) % _TRIAL_EVERY < 2

    def _median(self) -> int:
        return sorted(self._recent)[_RECENT // 2]

    def _is_hot(self, temperature_raw: int) -> bool:
        return (
            temperature_raw != NOT_READ
            and self._temperature_raw is not None
            and abs(temperature_raw - self._temperature_raw) > self._jump_temperature_counts
        )
