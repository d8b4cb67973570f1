"""How long each part is waited for, and whether it still keeps the time it was measured to need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from devices.array.budget import BusTiming
from devices.array.health import TileHealth
from devices.array.ports import TilePorts
from devices.chips.mpl115a2 import CONVERSION_MAX_NS
from devices.clock import Clock
from devices.frames import NOT_READ

SLOW_AUDIT_NS = 500_000_000
"""Interval of trials of a slow part, to notice when it is quick again."""

_HESITATION_NS = 100_000
"""A read that comes later than planned by this much proves nothing."""

_TRIES, _SLOW_TRIES, _SAME_MAX = 8, 2, 3
"""Every second pair of healthy readings has the same temperature: eight are one in 250. One that is
known to be slow is asked less often each time: whether it is quick again need not be known at once.
"""


class ConversionWatch:
    """Waits of all tiles, and what keeps them true.

    A reading that is taken too early is that of the conversion before. If the part is started again
    right after it, nothing ever finishes, and its words stand still, which is noticed. If it has
    time to finish until the next CONVERT, its words change from frame to frame like any other, one
    frame late, and betray nothing: so in some frames one tile is read again before that CONVERT,
    and has to be the same. A suspect is tried: is a conversion finished after the measured time?
    """

    def __init__(
        self,
        ports: TilePorts,
        clock: Clock,
        health: Sequence[TileHealth],
        timing: BusTiming,
    ) -> None:
        self._measured_ns = tuple(round(wait_s * 1e9) for wait_s in timing.conversions_s)
        self.wait_ns = list(self._measured_ns)
        """How long to wait for each tile's conversion."""
        self._ports = ports
        self._clock = clock
        self._health = health
        whole = replace(timing, bytes_read=4.0)
        self._wires_ns = round((whole.convert_s + whole.read_s) * 1e9)
        self._suspects: list[int] = []
        self._slow_due_ns = 0
        self._tries = 0

    def look_again(self, tile: int, words: tuple[int, int]) -> None:
        """Read a tile again that gave `words` and was not started since.

        Raises:
            I2cError: it does not answer.
        """
        if self._health[tile].slow:
            return
        self._ports.connect(tile)
        padc, tadc = self._ports.read(with_temperature=True)
        if padc != words[0] or words[1] not in (tadc, NOT_READ):
            self.suspect(tile)

    def suspect(self, tile: int) -> None:
        """This tile's words may be too old."""
        if tile not in self._suspects and not self._health[tile].slow:
            self._suspects.append(tile)

    def to_try(self) -> int | None:
        """A tile whose conversion should be tried now, or None."""
        if self._suspects:
            return self._suspects.pop(0)
        now_ns = self._clock.now_ns()
        slow = [i for i, health in enumerate(self._health) if health.slow and health.present]
        if slow and now_ns >= self._slow_due_ns:
            self._slow_due_ns = now_ns + SLOW_AUDIT_NS
            self._tries += 1
            return slow[self._tries % len(slow)]
        return None

    def try_conversion(self, tile: int) -> None:
        """Find out whether a part keeps its time, and wait for it accordingly from now on.

        As in the self-test there is one read for each CONVERT: to read a conversion that is not
        finished may abort it. Its conversion has to be started again afterwards.

        Raises:
            I2cError: it does not answer.
        """
        health = self._health[tile]
        tries = _SLOW_TRIES if health.slow else _TRIES
        settled = [self._settled(tile)]
        early: list[tuple[int, int]] = []
        for _ in range(tries):
            words, in_time = self._converted(tile, self._measured_ns[tile])
            if not in_time:
                settled[-1] = self._settled(tile)
                continue
            early.append(words)
            if early[-1][1] != settled[-1][1]:
                self._believe(tile)  # the temperature is loaded last: this one was finished
                return
            settled.append(self._settled(tile))
            if len(early) >= _SAME_MAX and early == settled[: len(early)]:
                break  # not a word of it has changed: it is late
        if len({tadc for _, tadc in settled}) == 1 and any(
            words != before for words, before in zip(early, settled, strict=False)
        ):
            self._believe(tile)  # its temperature never changes, so its pressure has to tell
        elif len(early) >= _SAME_MAX and len(set(settled)) > 1 and not health.slow:
            # It does finish, but late. (If it never does, nothing is worth waiting for.)
            health.slow = True
            self.wait_ns[tile] = max(self._measured_ns[tile], CONVERSION_MAX_NS)
        self._slow_due_ns = self._clock.now_ns() + SLOW_AUDIT_NS

    def _believe(self, tile: int) -> None:
        self._health[tile].slow = False
        self.wait_ns[tile] = self._measured_ns[tile]

    def _settled(self, tile: int) -> tuple[int, int]:
        """The words of a conversion that had all its time."""
        return self._converted(tile, CONVERSION_MAX_NS)[0]

    def _converted(self, tile: int, delay_ns: int) -> tuple[tuple[int, int], bool]:
        """The words read `delay_ns` after a CONVERT, and whether they were read on time.

        A busy machine may pause before either transfer, so all time except that on the wires counts
        as waiting. The conversion always gets its time.
        """
        begin_ns = self._clock.now_ns()
        self._ports.convert([tile])
        stop_ns = self._clock.now_ns()
        self._clock.sleep_until_ns(stop_ns + delay_ns)
        words = self._ports.read(with_temperature=True)
        waited_ns = self._clock.now_ns() - begin_ns - self._wires_ns
        self._clock.sleep_until_ns(stop_ns + CONVERSION_MAX_NS)
        return words, waited_ns <= delay_ns + _HESITATION_NS
