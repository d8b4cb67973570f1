"""Monitor of the bus as a whole: detects a stuck bus, starts recovery, detects its return."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from devices.array.tile import Scan
from devices.chips.tca9548a import MuxRouter
from devices.clock import Clock
from devices.errors import BusFaultError, BusSetupError
from devices.recovery import BusRecovery

_RECOVERY_NS = (10_000_000, 1_000_000_000)
"""First and longest interval between recovery attempts."""

ADAPTER_REOPEN_NS = 1_000_000_000
"""Time without a working bus after which the adapter is reopened."""


@dataclass(frozen=True)
class RecoveryResult:
    """Result of an attempt to free the bus.

    Attributes:
        succeeded: True if the bus works again.
        problem: reason why a step could not be tried; empty if all were.
    """

    succeeded: bool
    problem: str = ""


def recover_bus(recovery: BusRecovery, is_bus_working: Callable[[], bool]) -> RecoveryResult:
    """Free a stuck bus by nine clocks, then by the multiplexers' RESET, until `moves()` is True.

    High lines do not prove that the bus works: a slave may pull them low again. A GPIO line that is
    busy now may be free at the next attempt.
    """
    problems = []
    for help_ in (recovery.send_recovery_clocks, recovery.reset_muxes):
        try:
            helped = help_()
        except BusSetupError as error:
            problems.append(str(error))
            continue
        if helped and is_bus_working():
            return RecoveryResult(succeeded=True)
    return RecoveryResult(succeeded=False, problem="; ".join(problems))


class BusMonitor:
    """Monitor of one bus.

    A stuck SDA acknowledges everything and reads as zeros, an open one acknowledges nothing
    (hardware.md 3.2). To tell these from faulty tiles, the monitor writes a multiplexer's register
    and reads it back.
    """

    def __init__(self, router: MuxRouter, clock: Clock, recovery: BusRecovery | None) -> None:
        self.is_down = False
        self.recovery_attempts = 0
        """Number of recovery attempts."""
        self.problem = ""
        """Reason why the last recovery failed; empty after success or without recovery."""
        self._router = router
        self._clock = clock
        self._recovery = recovery
        self._wait_ns, self._due_ns = _RECOVERY_NS[0], 0
        self._renewal_due_ns = 0

    def check_bus(self, scan: Scan) -> None:
        """Check the bus after zeros or silence; abandon the frame if it fails."""
        if not self._is_working():
            scan.count_bus_fault(abandons_frame=True)

    def mark_down(self) -> None:
        """Mark the bus as down: no transfers to tiles until it works again."""
        self.is_down = True
        self.problem = ""
        self._wait_ns, self._due_ns = _RECOVERY_NS[0], 0
        self._renewal_due_ns = self._clock.now_ns() + ADAPTER_REOPEN_NS

    @property
    def warning(self) -> str:
        """Warning about the bus; empty if it works."""
        if not self.is_down:
            return ""
        if not self._router.bus.is_open:
            why = f": {self._router.bus.reopen_error}" if self._router.bus.reopen_error else ""
            return f"the adapter of the bus is missing; retry every second{why}"
        failure = f"; recovery failed: {self.problem}" if self.problem else ""
        return f"the bus is stuck or cut{failure}"

    def try_reconnect(self) -> bool:
        """Return whether a bus that was down works again; reopen or recover it if due."""
        bus = self._router.bus
        if not bus.ensure_open(self._clock.now_ns()):
            return False
        back = self._is_working()
        if not back and bus.is_open and self._clock.now_ns() >= self._renewal_due_ns:
            # After replugging a USB adapter its open file fails with EIO for ever.
            self._renewal_due_ns = self._clock.now_ns() + ADAPTER_REOPEN_NS
            bus.release_adapter()
            return False
        if not back and self._recovery is not None and self._clock.now_ns() >= self._due_ns:
            self.recovery_attempts += 1
            given = recover_bus(self._recovery, self._is_working)
            back, self.problem = given.succeeded, given.problem
            self._due_ns = self._clock.now_ns() + self._wait_ns
            self._wait_ns = min(2 * self._wait_ns, _RECOVERY_NS[1])
        self.is_down = not back
        return back

    def _is_working(self) -> bool:
        try:
            return self._router.check_any_mux_works()
        except BusFaultError:
            return False
