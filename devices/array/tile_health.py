"""Health of a tile, inferred from its readings alone.

The protocol has no checksum and the part no status bit (hardware.md 1.1, 8). Evidence of a fault:
counts that no working part gives, a jump that a second read does not confirm, readings that never
change, and other factory coefficients than at start-up.
"""

from __future__ import annotations

from collections import Counter, deque

from devices.chips.mpl115a2 import COUNTS_MAX, Coefficients, compute_kpa_per_padc
from devices.flags import TileFlag
from devices.frames import NOT_READ, TileInfo

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
