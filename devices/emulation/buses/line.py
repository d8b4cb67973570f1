"""The two wires of the bus when something is wrong with them.

`sda_low`: a slave holds SDA: every bit reads as 0, so every acknowledge is there, every byte reads
00, and no device hears anything (hardware.md 3.2). It hangs in the middle of a byte and lets go
after the clocks that are left of it. `sda_high`: SDA is open and reads as 1: no answer.
`scl_low`: nothing moves, the adapter gives up after its time-out. `adapter_timeout`: the same once,
by chance. `nack_storm` and `bit_errors`: single acknowledges and bits are lost by chance, on every
byte with the fault's rate; there is no checksum in this protocol.
"""

from __future__ import annotations

import random

from devices.emulation.faults import Fault, Faults

_ADDRESS_BITS = 8


class Line:
    """SDA and SCL, healthy but for `faults`; chance is drawn from `label`."""

    def __init__(self, faults: Faults, label: str) -> None:
        self.sda_low = faults.of("sda_low")
        self.sda_high = faults.of("sda_high")
        self.scl_low = faults.of("scl_low")
        self.adapter_timeout = faults.of("adapter_timeout")
        self._nack_storm = faults.of("nack_storm")
        self._bit_errors = faults.of("bit_errors")
        self._faults = faults
        # Not numpy's: a draw for every byte has to be cheap. A label's text seeds it the same way
        # on every machine.
        self._rng = random.Random(label)  # noqa: S311  # no secret

    @property
    def sound(self) -> bool:
        """Is nothing wrong on this bus, now or later?"""
        return not self._faults.possible

    def wedged(self, t_ns: int) -> bool:
        """Does a transfer that begins now end in the adapter's time-out?"""
        if self.scl_low(t_ns):
            return True
        return self._happens(self.adapter_timeout, t_ns)

    def loses_acknowledge(self, t_ns: int) -> bool:
        """Is this acknowledge not seen?"""
        return self._happens(self._nack_storm, t_ns)

    def disturbed(self, value: int, t_ns: int) -> int:
        """The byte as it arrives: with one bit turned over, by chance."""
        if self._happens(self._bit_errors, t_ns):
            return value ^ 1 << self._rng.randrange(_ADDRESS_BITS)
        return value

    def _happens(self, fault: Fault, t_ns: int) -> bool:
        rate = fault.rate(t_ns)
        return rate > 0.0 and self._rng.random() < rate
