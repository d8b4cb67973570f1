"""Does the bus move at all? Notices that it is stuck, helps it, and notices that it is back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from devices.array.ports import Scan
from devices.chips.tca9548a import MuxRouter
from devices.clock import Clock
from devices.errors import BusFaultError, BusSetupError
from devices.recovery.recovery import BusRecovery

_RECOVERY_NS = (10_000_000, 1_000_000_000)
"""A stuck bus is helped at once, then less and less often."""

RENEWAL_NS = 1_000_000_000
"""A bus that does not move for so long is opened anew."""


@dataclass(frozen=True)
class Help:
    """What became of an attempt to free the bus.

    Attributes:
        worked: does it move now?
        problem: why something could not even be tried; empty if all could.
    """

    worked: bool
    problem: str = ""


def help_bus(recovery: BusRecovery, moves: Callable[[], bool]) -> Help:
    """Nine clocks, and if the bus does not move after them, the multiplexers' RESET.

    Lines that are high are no proof that it moves: a slave may pull them low again. A line that
    cannot be had now may be had the next time.
    """
    problems = []
    for help_ in (recovery.clock_out, recovery.reset_muxes):
        try:
            helped = help_()
        except BusSetupError as error:
            problems.append(str(error))
            continue
        if helped and moves():
            return Help(worked=True)
    return Help(worked=False, problem="; ".join(problems))


class BusWatch:
    """The bus as a whole.

    A stuck SDA acknowledges everything and reads as zeros, an open one acknowledges nothing
    (hardware.md 3.2). What tells them from tiles in trouble is a multiplexer that keeps, or does
    not keep, what is written to it.
    """

    def __init__(self, router: MuxRouter, clock: Clock, recovery: BusRecovery | None) -> None:
        self.is_down = False
        self.recoveries = 0
        """How often a stuck bus was helped."""
        self.problem = ""
        """Why it could not be helped the last time; empty if it could, or there is no recovery."""
        self._router = router
        self._clock = clock
        self._recovery = recovery
        self._wait_ns, self._due_ns = _RECOVERY_NS[0], 0
        self._renewal_due_ns = 0

    def look(self, scan: Scan) -> None:
        """Nothing but zeros, or no answer at all: if it is the bus, the frame is given up."""
        if not self._moves():
            scan.note_bus_fault(for_good=True)

    def fall(self) -> None:
        """The bus has failed: nothing is asked of the tiles until it is back."""
        self.is_down = True
        self.problem = ""
        self._wait_ns, self._due_ns = _RECOVERY_NS[0], 0
        self._renewal_due_ns = self._clock.now_ns() + RENEWAL_NS

    @property
    def trouble(self) -> str:
        """What is wrong with the bus, in words; empty if nothing is."""
        if not self.is_down:
            return ""
        if not self._router.bus.is_open:
            why = f": {self._router.bus.problem}" if self._router.bus.problem else ""
            return f"the adapter of the bus is away, and is opened again every second{why}"
        unhelped = f" and could not be helped: {self.problem}" if self.problem else ""
        return f"the bus is stuck or cut{unhelped}"

    def comes_back(self) -> bool:
        """Check whether a bus that was down moves again; help it if need be."""
        bus = self._router.bus
        if not bus.reopen(self._clock.now_ns()):
            return False
        back = self._moves()
        if not back and bus.is_open and self._clock.now_ns() >= self._renewal_due_ns:
            # The open file of a USB adapter that was plugged in again fails with EIO for ever.
            self._renewal_due_ns = self._clock.now_ns() + RENEWAL_NS
            bus.let_go()
            return False
        if not back and self._recovery is not None and self._clock.now_ns() >= self._due_ns:
            self.recoveries += 1
            given = help_bus(self._recovery, self._moves)
            back, self.problem = given.worked, given.problem
            self._due_ns = self._clock.now_ns() + self._wait_ns
            self._wait_ns = min(2 * self._wait_ns, _RECOVERY_NS[1])
        self.is_down = not back
        return back

    def _moves(self) -> bool:
        try:
            return self._router.echoes()
        except BusFaultError:
            return False
