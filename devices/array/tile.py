"""Tile behind a multiplexer: its selection and transfers, and its health by its readings.

A `Scan` collects the readings and flags of one frame, and its remaining retry budget.

The protocol has no checksum and the part no status bit (hardware.md 1.1, 8). Evidence of a fault:
counts that no working part gives, a jump that a second read does not confirm, readings that never
change, and other factory coefficients than at start-up.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from devices.buses.i2c import I2cBus
from devices.chips.mpl115a2 import COUNTS_MAX, Coefficients, Mpl115a2, compute_kpa_per_padc
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


JUMP_KPA = 0.5
"""Distance from the median of the last three above which a reading is read again. That affects
1.7 % of a healthy part's readings (noise 0.165 kPa with outliers, hardware.md 1.3)."""
FAR_JUMP_KPA = 1.5
"""Distance beyond any outlier of a healthy part: if confirmed, the tile's identity is verified."""
JUMP_TADC = 5
"""Temperature does not change by a kelvin from one frame to the next (hardware.md 8)."""

STALE_EVIDENCE = 20
"""Evidence from which a tile is stale. A reading equal to the previous one counts two, or one if
only the pressure was read. One in nine readings of a healthy part equals its neighbour, so ten in a
row occur once in 10^9; with noise that is correlated over 10 ms once in 10^6."""

_TRIAL_EVERY = 2048  # every two seconds at 500 frames a second
_TADC_MAX_NS = 500_000_000  # half the hold of `devices.temperature_hold`
_IMPOSSIBLE_TADC = (0, COUNTS_MAX)
_FIRST_PROBE_NS = 2_000_000  # a loose plug is back within a few milliseconds
_PROBES_NS = 1_000_000_000  # longest interval between probes
_RECENT = 3  # a single outlier does not move the median of three


def classify_impossible_counts(pressure_raw: int, temperature_raw: int) -> int:
    """Return the tile flag of counts that no working part gives; 0 if they are possible."""
    if pressure_raw == temperature_raw == 0:
        return TileFlag.NOT_CONVERTED  # registers after power-up
    # Both ends of the temperature are 100 K away from anything this foot survives.
    if temperature_raw in _IMPOSSIBLE_TADC:
        return TileFlag.IMPLAUSIBLE
    return 0


class TileHealth:
    """Recent readings and known faults of one tile."""

    def __init__(self, info: TileInfo) -> None:
        self.fault_counts: Counter[str] = Counter()
        """Fault counts, by the name of the flag."""
        self.coefficient_words = info.coefficient_words
        self.coefficient_bytes = b"".join(w.to_bytes(2, "big") for w in info.coefficient_words)
        self.is_present = True
        """True if the tile answers and is verified. Else its coefficients are checked first."""
        self.is_replaced = False
        """True if another part answers in its place."""
        self.is_slow = False
        """True if conversions take longer than measured at start-up."""
        chip = Coefficients.from_words(info.coefficient_words)
        count_kpa = abs(float(compute_kpa_per_padc(500, chip.b1, chip.c12)))
        self._jump = JUMP_KPA / count_kpa
        self._far_jump = FAR_JUMP_KPA / count_kpa
        self._recent: deque[int] = deque(maxlen=_RECENT)
        self._temperature_raw: int | None = None
        self._tadc_ns = 0
        self._last_words = (NOT_READ, NOT_READ)
        self._stale_evidence = 0
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
        """Mark the tile as unverified: another part may answer, so check its coefficients."""
        self.is_present = False
        self._probe_due_ns = now_ns
        self._probe_wait_ns = _FIRST_PROBE_NS
        self._recent.clear()
        self._temperature_raw = None
        self._stale_evidence = 0

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
        return self._temperature_raw is None or now_ns - self._tadc_ns > _TADC_MAX_NS

    def is_jump(self, pressure_raw: int, temperature_raw: int, *, is_strict: bool = False) -> bool:
        """Return whether a reading is far from the previous ones, or has too few to compare with.

        Strictly: half the distance is too far, for a line that is known to be disturbed.
        """
        if len(self._recent) < _RECENT:
            return True
        limit = self._jump / 2 if is_strict else self._jump
        return abs(pressure_raw - self._median()) > limit or self._is_hot(temperature_raw)

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
            self._tadc_ns = now_ns

    def update_staleness(self, pressure_raw: int, temperature_raw: int) -> bool:
        """Update the evidence with a frame's reading; return whether the tile is stale."""
        if pressure_raw == NOT_READ:
            return False
        same = pressure_raw == self._last_words[0] and (
            temperature_raw == NOT_READ or self._last_words[1] in (temperature_raw, NOT_READ)
        )
        if same:
            self._stale_evidence += 1 if temperature_raw == NOT_READ else 2
        else:
            self._stale_evidence = 0
        self._last_words = (
            pressure_raw,
            self._last_words[1] if same and temperature_raw == NOT_READ else temperature_raw,
        )
        return self.has_stale_readings

    @property
    def has_stale_readings(self) -> bool:
        """True if the readings are stale."""
        return self._stale_evidence >= STALE_EVIDENCE

    @property
    def is_trial_due(self) -> bool:
        """True if the conversion time of a stale tile should be tested: at first, then at times."""
        return 0 <= (self._stale_evidence - STALE_EVIDENCE) % _TRIAL_EVERY < 2

    def _median(self) -> int:
        return sorted(self._recent)[_RECENT // 2]

    def _is_hot(self, temperature_raw: int) -> bool:
        return (
            temperature_raw != NOT_READ
            and self._temperature_raw is not None
            and abs(temperature_raw - self._temperature_raw) > JUMP_TADC
        )
