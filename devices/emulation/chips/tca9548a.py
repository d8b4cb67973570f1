"""Emulated TCA9548A at register level (data sheet SCPS207G, 8.5)."""

from __future__ import annotations

from collections.abc import Iterable

from devices.emulation.fault_timing import FaultTiming
from devices.emulation.i2c_bus import I2cDevice


class EmulatedTca9548a:
    """Emulated multiplexer: one control register without an address; bit n connects channel n.

    A written value is latched with its acknowledge and takes effect at STOP (8.5.4). Of several
    data bytes the last one counts. Power-up value 0: no channel is connected.

    A channel may have several devices, at addresses of their own.

    Faults: `brown_out`: no supply, so it is silent and connects no channel; `mux_reset`: its RESET
    line or a dip of the supply deselects all channels.
    """

    def __init__(
        self,
        address: int,
        devices: Iterable[tuple[int, I2cDevice]],
        brown_out: FaultTiming | None = None,
        mux_reset: FaultTiming | None = None,
    ) -> None:
        self.address = address
        self._devices = tuple(devices)
        self._brown_out = brown_out if brown_out is not None else FaultTiming()
        self._mux_reset = mux_reset if mux_reset is not None else FaultTiming()
        self._seen_ns = 0
        self._latched = 0
        self.connected_mask = 0
        """Connected channels."""

    def apply_faults(self, t_ns: int) -> None:
        """Apply faults since the last call."""
        since_ns, self._seen_ns = self._seen_ns, t_ns
        if self._brown_out.was_active_between(since_ns, t_ns) or self._mux_reset.began_between(
            since_ns, t_ns
        ):
            self.reset()

    def reset(self) -> None:
        """Reset as by the RESET line: no channel is connected."""
        self._latched = self.connected_mask = 0

    def interrupt_supply(self) -> None:
        """Interrupt the supply of the mux and of all chips behind it for a moment."""
        self.reset()
        for _, device in self._devices:
            device.interrupt_supply()

    def on_address(self, reading: bool, t_ns: int) -> bool:
        """Return the acknowledge, in both directions: True with a supply."""
        return not self._brown_out(t_ns)

    def receive_byte(self, value: int) -> bool:
        """Latch the control register."""
        self._latched = value
        return True

    def send_bytes(self, count: int) -> bytes:
        """Send the control register, repeated in a longer read."""
        return bytes([self._latched]) * count

    def on_stop(self, t_ns: int) -> None:
        """Connect the latched channels."""
        self.connected_mask = self._latched

    def get_connected_devices(self) -> Iterable[I2cDevice]:
        """Return the devices on the connected channels."""
        return [device for channel, device in self._devices if self.connected_mask >> channel & 1]
