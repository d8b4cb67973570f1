"""TI TCA9548A: one control register, one bit per channel, in force after the next STOP.

Source: TCA9548A data sheet SCPS207G, 8.5.3 and 8.5.4. Because the selection acts at STOP only, a
select and the access behind it can never share a transaction; every method here is one transaction.
"""

from __future__ import annotations

from collections.abc import Iterable

from devices.errors import I2cError
from devices.i2c import I2cBus, i2c_msg

ADDRESSES = range(0x70, 0x78)
CHANNELS = range(8)


class Tca9548a:
    """One multiplexer: writes its control register and reads it back."""

    def __init__(self, bus: I2cBus, address: int) -> None:
        self.address = address
        self._bus = bus
        # No register address: the one data byte is the channel mask.
        self._writes = [i2c_msg.write(address, [mask]) for mask in range(256)]
        self._read = i2c_msg.read(address, 1)

    def write_mask(self, mask: int) -> None:
        """Connect the channels whose bits are set in `mask` (0..255) from the STOP on."""
        self._bus.transfer(self._writes[mask])

    def read_mask(self) -> int:
        """The channels that are connected now."""
        self._bus.transfer(self._read)
        return bytes(self._read)[0]


class MuxRouter:
    """Keeps all multiplexers of a bus such that only what is asked for is connected.

    All tiles share one address, so a channel left open on another mux would answer too: reads would
    return the AND of two tiles, plausible and wrong. The state is cached, because a select costs
    50 us, and the cache is forgotten after any error, because then nothing is known.
    """

    def __init__(self, bus: I2cBus, addresses: Iterable[int]) -> None:
        self._muxes = {address: Tca9548a(bus, address) for address in sorted(set(addresses))}
        self._masks: dict[int, int | None] = dict.fromkeys(self._muxes)

    @property
    def addresses(self) -> tuple[int, ...]:
        """Addresses of the multiplexers, ascending."""
        return tuple(self._muxes)

    def connect(self, masks: dict[int, int]) -> None:
        """Connect exactly the channels of `masks` (address to mask); all other muxes are closed.

        Muxes are closed before others are opened, so that no two overlap in between.

        Raises:
            I2cError: a mux did not answer; nothing is known of the routing then.
        """
        try:
            for address, mask in self._masks.items():
                if mask != 0 and not masks.get(address):
                    self._write(address, 0)
            for address, mask in masks.items():
                if self._masks[address] != mask:
                    self._write(address, mask)
        except I2cError:
            self.forget()
            raise

    def connect_only(self, address: int, channel: int) -> None:
        """Connect one channel of one mux and nothing else."""
        self.connect({address: 1 << channel})

    def forget(self) -> None:
        """Drop the cached state: the next `connect` writes every mux again."""
        self._masks = dict.fromkeys(self._muxes)

    def _write(self, address: int, mask: int) -> None:
        self._muxes[address].write_mask(mask)
        self._masks[address] = mask
