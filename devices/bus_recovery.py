"""Freeing a bus that is stuck."""

from __future__ import annotations

from typing import Protocol


class BusRecovery(Protocol):
    """What can be done to a stuck bus from outside of it."""

    def clock_out(self) -> bool:
        """Nine clocks and a STOP, so that a slave that hangs in a byte lets go; True if it did."""

    def reset_muxes(self) -> bool:
        """Pulse the multiplexers' RESET line; False if none is wired."""
