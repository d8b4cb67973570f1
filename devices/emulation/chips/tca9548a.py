"""Emulated TCA9548A at register level (data sheet SCPS207G, 8.5)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from devices.emulation.buses.i2c import I2cDevice
from devices.emulation.faults import Fault


class EmulatedTca9548a:
    """Emulated multiplexer: one control register without an address; bit n connects channel n.

    A written value is latched with its acknowledge and takes effect at STOP (8.5.4). Of several
    data bytes the last one counts. Power-up value 0: no channel is connected.

    Faults: `brown_out`: no supply, so it is silent and connects no channel; `mux_reset`: its RESET
    line or a dip of the supply deselects all channels.
    """

    def __init__(
        self,
        address: int,
        channels: Mapping[int, I2cDevice],
        brown_out: Fault | None = None,
        mux_reset: Fault | None = None,
    ) -> None:
        self.address = address
        self._channels = dict(channels)
        self._brown_out = brown_out if brown_out is not None else Fault()
        self._mux_reset = mux_reset if mux_reset is not None else Fault()
        self._seen_ns = 0
        self._latched = 0
        self.mask = 0
        """Connected channels."""

    def suffer(self, t_ns: int) -> None:
        """Apply faults since the last call."""
        since_ns, self._seen_ns = self._seen_ns, t_ns
        if self._brown_out.struck(since_ns, t_ns) or self._mux_reset.set_in(since_ns, t_ns):
            self.reset()

    def reset(self) -> None:
        """Reset as by the RESET line: no channel is connected."""
        self._latched = self.mask = 0

    def lose_supply(self) -> None:
        """Interrupt the supply of the mux and of all chips behind it for a moment."""
        self.reset()
        for device in self._channels.values():
            device.lose_supply()

    def start(self, reading: bool, t_ns: int) -> bool:
        """Return the acknowledge, in both directions: True with a supply."""
        return not self._brown_out(t_ns)

    def write(self, value: int) -> bool:
        """Latch the control register."""
        self._latched = value
        return True

    def read(self, count: int) -> bytes:
        """Send the control register, repeated in a longer read."""
        return bytes([self._latched]) * count

    def stop(self, t_ns: int) -> None:
        """Connect the latched channels."""
        self.mask = self._latched

    def connected(self) -> Iterable[I2cDevice]:
        """Return the devices on the connected channels."""
        return [device for channel, device in self._channels.items() if self.mask >> channel & 1]
