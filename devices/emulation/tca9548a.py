"""TCA9548A at register level (data sheet SCPS207G, 8.5)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from devices.emulation.i2c_bus import I2cDevice


class EmulatedTca9548a:
    """One control register without a register address; bit n connects channel n.

    A written value is latched with its acknowledge and comes into force at STOP (8.5.4). Of several
    data bytes the last one counts. Power-up value 0: nothing is connected.
    """

    def __init__(self, address: int, channels: Mapping[int, I2cDevice]) -> None:
        self.address = address
        self._channels = dict(channels)
        self._latched = 0
        self.mask = 0
        """Channels in force."""

    def start(self, reading: bool, t_ns: int) -> bool:
        """Acknowledge, in both directions."""
        return True

    def write(self, value: int) -> bool:
        """Latch the control register."""
        self._latched = value
        return True

    def read(self, count: int) -> bytes:
        """Give the control register; every byte of a longer read is the same one."""
        return bytes([self._latched]) * count

    def stop(self, t_ns: int) -> None:
        """Bring the latched channels into force."""
        self.mask = self._latched

    def connected(self) -> Iterable[I2cDevice]:
        """Devices on the channels in force."""
        return [device for channel, device in self._channels.items() if self.mask >> channel & 1]
