"""The wall clock of single processes, stepped while they run; the machine's own is left alone."""

from __future__ import annotations

from pathlib import Path

from tests.faults.product import hand_over

HOUR_NS = 3_600_000_000_000


class WallClock:
    """A clock that is off by as much as the harness says (`bootstrap/fault_clock.py`).

    Args:
        file: where the offset is handed over; made.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self.step_to(0)

    def step_to(self, offset_ns: int) -> None:
        """From some 20 ms on the processes see the machine's time plus this offset."""
        hand_over(self._file, str(offset_ns))

    def environment(self) -> dict[str, str]:
        """What a process needs in its environment to see it."""
        return {"FAULTS_CLOCK": str(self._file)}
