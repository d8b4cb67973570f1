"""Detects that a servo restarted, from its Realtime Tick: milliseconds since it was switched on.

The register counts 0 to 32767 and begins again (e-manual, Realtime Tick), so after a silence of
half a minute it tells nothing. Firmware of Protocol 1.0 before version 40 has no such register;
then a servo that was silent may have restarted.
"""

from __future__ import annotations

TICKS = 32_768
_TOLERANCE_MS, _TOLERANCE_PART = 20.0, 0.05  # of the servo's own clock: not documented
_SILENCE_MAX_MS = 25_000.0  # beyond it the tolerance and the wrap leave no answer


class UptimeWatch:
    """Compares each tick with the one before."""

    def __init__(self) -> None:
        self._tick: int | None = None
        self._t_ns = 0
        self._is_supported = True

    def has_restarted(self, tick: int | None, t_ns: int, *, silent_ns: int) -> bool:
        """Return whether the servo restarted since the tick before, or may have.

        Args:
            tick: as read now; None: the servo has no such register.
            t_ns: instant of the clock.
            silent_ns: how long the servo has not answered before that; 0: it answered all along.
        """
        before, elapsed_ms = self._tick, (t_ns - self._t_ns) * 1e-6
        self._tick, self._t_ns = tick, t_ns
        if before is None and tick is not None:
            return False
        if tick is None or (tick == before and elapsed_ms > _TOLERANCE_MS):
            self._is_supported = False  # it stands still: firmware without this register
        if not self._is_supported or tick is None or before is None:
            return silent_ns > 0
        if elapsed_ms > _SILENCE_MAX_MS:
            return True
        off_ms = (tick - before - elapsed_ms + TICKS / 2) % TICKS - TICKS / 2
        if abs(off_ms) > _TOLERANCE_MS + _TOLERANCE_PART * elapsed_ms:
            return True
        # It fits, but so would by chance the tick of a servo that was switched on in the silence.
        return silent_ns > 0 and tick <= silent_ns * 1e-6 + _TOLERANCE_MS
