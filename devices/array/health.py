"""What a driver can know of one tile from the words it gives: is this sample to be believed?

There is no checksum in this protocol and no status bit in the part (hardware.md 1.1, 8). What there
is: words that no working part gives, a reading that jumps and does not come again when asked twice,
readings that never change, and eight coefficients that are burnt into each part.
"""

from __future__ import annotations

from collections import Counter, deque

from devices.chips.mpl115a2 import COUNTS_MAX, Coefficients, kpa_per_padc
from devices.frames import NOT_READ, TileInfo, TileStatus

JUMP_KPA = 0.5
"""A reading this far from the median of the last three is read again. Of a healthy part's, 1.7 in
a hundred are (noise 0.165 kPa with outliers, hardware.md 1.3)."""
FAR_JUMP_KPA = 1.5
"""Farther than any outlier of a healthy part: if it comes again, is it this tile that answers?"""
JUMP_TADC = 5
"""Temperature does not change by a kelvin from one frame to the next (hardware.md 8)."""

STALE_EVIDENCE = 20
"""A reading equal to the one before counts two, or one if only the pressure was read. Of healthy
readings one in nine is equal to its neighbour, so ten in a row come once in 10^9; with noise that
is correlated over 10 ms once in 10^6."""

_TRIAL_EVERY = 2048  # every two seconds at 500 frames a second
_TADC_MAX_NS = 500_000_000  # half of what `devices.temperature` holds one for
_IMPOSSIBLE_TADC = (0, COUNTS_MAX)
_FIRST_PROBE_NS = 2_000_000  # a loose plug is back within a few milliseconds
_PROBES_NS = 1_000_000_000  # what has been away for long is asked once a second
_RECENT = 3  # the median of three is moved by no single outlier


def is_impossible(padc: int, tadc: int) -> int:
    """The `TileStatus` of words that no working part gives; 0 if these can be."""
    if padc == tadc == 0:
        return TileStatus.NOT_CONVERTED  # registers of a part that was just switched on
    # Both ends of the temperature are 100 K away from anything this foot survives.
    if tadc in _IMPOSSIBLE_TADC:
        return TileStatus.IMPLAUSIBLE
    return 0


class TileHealth:
    """One tile: its recent readings, and what is known to be wrong with it."""

    def __init__(self, info: TileInfo) -> None:
        self.counts: Counter[str] = Counter()
        """Counts of faults, by reason."""
        self.coefficient_words = info.coefficient_words
        self.coefficient_bytes = b"".join(w.to_bytes(2, "big") for w in info.coefficient_words)
        self.present = True
        """Does it answer? If not, its coefficients are read before it is believed again."""
        self.replaced = False
        """Another part answers in its place."""
        self.slow = False
        """It takes longer to convert than was measured."""
        chip = Coefficients.from_words(info.coefficient_words)
        count_kpa = abs(float(kpa_per_padc(500, chip.b1, chip.c12)))
        self._jump = JUMP_KPA / count_kpa
        self._far_jump = FAR_JUMP_KPA / count_kpa
        self._recent: deque[int] = deque(maxlen=_RECENT)
        self._tadc: int | None = None
        self._tadc_ns = 0
        self._last_words = (NOT_READ, NOT_READ)
        self._stale_evidence = 0
        self._probe_due_ns = 0
        self._probe_wait_ns = 0

    # Presence

    def lose(self, now_ns: int) -> None:
        """The tile does not answer, or its words are impossible; probe it ever less often."""
        if self.present:
            self.doubt(now_ns)
        else:
            self._probe_due_ns = now_ns + self._probe_wait_ns
            self._probe_wait_ns = min(2 * self._probe_wait_ns, _PROBES_NS)

    def doubt(self, now_ns: int) -> None:
        """Another part may answer now: its coefficients must be read before its readings count."""
        self.present = False
        self._probe_due_ns = now_ns
        self._probe_wait_ns = _FIRST_PROBE_NS
        self._recent.clear()
        self._tadc = None
        self._stale_evidence = 0

    def is_probe_due(self, now_ns: int) -> bool:
        """Is it time to check whether the tile is back?"""
        return now_ns >= self._probe_due_ns

    def note(self, status: int) -> None:
        """Count the faults that a frame shows of it."""
        self.counts.update(bit.name.lower() for bit in TileStatus(status) if bit.name)

    def find(self) -> None:
        """The tile is back, and it is the same part."""
        self.present = True

    # Readings

    def wants_temperature(self, now_ns: int) -> bool:
        """Is its last temperature missing or too old?"""
        return self._tadc is None or now_ns - self._tadc_ns > _TADC_MAX_NS

    def jumps(self, padc: int, tadc: int, *, strictly: bool = False) -> bool:
        """Is it too far from the readings before, or are there none yet to compare it with?

        Strictly: half as far is too far, for a line that is known to be disturbed.
        """
        if len(self._recent) < _RECENT:
            return True
        limit = self._jump / 2 if strictly else self._jump
        return abs(padc - self._median()) > limit or self._is_hot(tadc)

    def may_be_another(self, padc: int, tadc: int) -> bool:
        """May another tile, or two at once, have sent this reading, although it came twice?"""
        if len(self._recent) < _RECENT:
            return False
        return abs(padc - self._median()) > self._far_jump or self._is_hot(tadc)

    def believe(self, padc: int, tadc: int, now_ns: int) -> None:
        """Take in a reading that was accepted."""
        self._recent.append(padc)
        if tadc != NOT_READ:
            self._tadc = tadc
            self._tadc_ns = now_ns

    def is_stale(self, padc: int, tadc: int) -> bool:
        """Take note of a frame's reading; has it been the same for too long?"""
        if padc == NOT_READ:
            return False
        same = padc == self._last_words[0] and (
            tadc == NOT_READ or self._last_words[1] in (tadc, NOT_READ)
        )
        if same:
            self._stale_evidence += 1 if tadc == NOT_READ else 2
        else:
            self._stale_evidence = 0
        self._last_words = (padc, self._last_words[1] if same and tadc == NOT_READ else tadc)
        return self.is_repeating

    @property
    def is_repeating(self) -> bool:
        """Are its readings stale?"""
        return self._stale_evidence >= STALE_EVIDENCE

    @property
    def wants_trial(self) -> bool:
        """Should the cause of stale readings be checked? At the first, then now and then."""
        return 0 <= (self._stale_evidence - STALE_EVIDENCE) % _TRIAL_EVERY < 2

    def _median(self) -> int:
        return sorted(self._recent)[_RECENT // 2]

    def _is_hot(self, tadc: int) -> bool:
        return tadc != NOT_READ and self._tadc is not None and abs(tadc - self._tadc) > JUMP_TADC
