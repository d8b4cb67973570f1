"""Detection of servo restarts by the Realtime Tick: milliseconds since power-up.

The register counts 0 to 32767 and wraps (e-manual, Realtime Tick), so after a silence of half a
minute it is ambiguous. Firmware of Protocol 1.0 before version 40 has no such register; then any
silence may have been a restart.
"""

from __future__ import annotations

TICK_PERIOD = 32_768
_TOLERANCE_MS, _TOLERANCE_PART = 20.0, 0.05  # of the servo's own clock: not documented
_SILENCE_MAX_MS = 25_000.0  # beyond it the tolerance and the wrap leave no answer


class RestartDetector:
    """Detector that compares each tick with the previous one."""

    def __init__(self) -> None:
        self._tick: int | None = None
        self._t_ns = 0
        self._is_supported = True

    def detect_restart(self, tick_ms: int | None, t_ns: int, *, silent_ns: int) -> bool:
        """Update with a tick; return whether the servo restarted, or may have, since the last one.

        Args:
            tick_ms: present tick; None: the servo has no such register.
            t_ns: instant of the clock.
            silent_ns: time without an answer before `t_ns`; 0: the servo answered all along.
        """
        before, elapsed_ms = self._tick, (t_ns - self._t_ns) * 1e-6
        self._tick, self._t_ns = tick_ms, t_ns
        if before is None and tick_ms is not None:
            return False
        if tick_ms is None or (tick_ms == before and elapsed_ms > _TOLERANCE_MS):
            self._is_supported = False  # a constant tick: firmware without this register
        if not self._is_supported or tick_ms is None or before is None:
            return silent_ns > 0
        if elapsed_ms > _SILENCE_MAX_MS:
            return True
        off_ms = (tick_ms - before - elapsed_ms + TICK_PERIOD / 2) % TICK_PERIOD - TICK_PERIOD / 2
        if abs(off_ms) > _TOLERANCE_MS + _TOLERANCE_PART * elapsed_ms:
            return True
        # The tick fits, but a servo powered up during the silence could match by chance.
        return silent_ns > 0 and tick_ms <= silent_ns * 1e-6 + _TOLERANCE_MS
