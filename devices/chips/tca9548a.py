"""Driver of the TI TCA9548A I2C multiplexer: one control register, one bit per channel.

Source: TCA9548A data sheet SCPS207G, 8.5.3 and 8.5.4. A selection acts at STOP only, so a select
and the access behind it are two transactions; every method of `Tca9548a` is one transaction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from devices.buses.i2c import I2cBus, i2c_msg
from devices.errors import NoAcknowledgeError

ADDRESSES = range(0x70, 0x78)
CHANNELS = range(8)
SCL_MAX_HZ = 400_000
"""Highest bus clock (data sheet 6.6)."""

_REFUSALS_MAX = 2  # one refusal may be a disturbed bit


class Tca9548a:
    """Driver of one multiplexer: writes and reads its control register."""

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
        """Read the mask of the channels connected now."""
        self._bus.transfer(self._read)
        return bytes(self._read)[0]


class MuxRouter:
    """Router that connects only the requested channels of all multiplexers of a bus.

    All tiles share one address, so a tile on an open channel of another mux would answer too: reads
    would return the AND of two tiles, plausible and wrong. The state is cached, because a select
    costs 50 us; an unknown state is written again before other channels are connected.
    """

    def __init__(self, bus: I2cBus, addresses: Iterable[int]) -> None:
        self.bus = bus
        self._muxes = {address: Tca9548a(bus, address) for address in sorted(set(addresses))}
        self._masks: dict[int, int | None] = dict.fromkeys(self._muxes)
        self._refusals = dict.fromkeys(self._muxes, 0)
        self.refused_address: int | None = None
        """The mux that did not acknowledge in the last `connect`; None if all did."""
        self.silent_addresses: set[int] = set()
        """Muxes that did not acknowledge being closed. They are assumed to be without supply, so to
        connect no channel; callers that read a tile of another mux have to verify it."""

    def connect_channels(self, masks_by_address: Mapping[int, int]) -> None:
        """Connect exactly the channels of `masks` (address to mask) and close all other muxes.

        Muxes are closed before others are opened, so that no two overlap in between.

        Raises:
            I2cError: a mux did not answer. A mux that fails to close twice in a row is `silent`
                from then on, and is skipped.
        """
        self.refused_address = None
        for address, mask in self._masks.items():
            if mask != 0 and not masks_by_address.get(address):
                self._close(address)
        for address, mask in masks_by_address.items():
            if self._masks[address] != mask:
                self._write(address, mask)

    def connect_single_channel(self, address: int, channel: int) -> None:
        """Connect one channel of one mux and nothing else."""
        self.connect_channels({address: 1 << channel})

    def invalidate_cache(self, address: int | None = None) -> None:
        """Discard the cached state of one mux, or of all: the next `connect` writes it again."""
        if address is not None:
            self._masks[address] = None
            return
        self._masks = dict.fromkeys(self._muxes)
        self._refusals = dict.fromkeys(self._muxes, 0)
        self.silent_addresses.clear()

    def verify_masks(self) -> bool:
        """Read back the mask of every mux; return whether all match the cached state.

        Discards the cached state of a mux that differs (after a reset) or does not answer.

        Raises:
            BusFaultError: the bus itself failed.
        """
        sound = True
        for address, mask in self._masks.items():
            if mask is None or address in self.silent_addresses:
                continue
            try:
                found: int | None = self._muxes[address].read_mask()
            except NoAcknowledgeError:
                found = None
            if found != mask:
                self._masks[address] = None
                sound = False
        return sound

    def check_any_mux_works(self) -> bool:
        """Return whether any mux returns a mask written to it, which proves that the bus works.

        With SDA stuck low a bus acknowledges everything and reads as zeros (hardware.md 3.2). The
        muxes are tried one after another.

        Raises:
            BusFaultError: the bus itself failed.
        """
        self.invalidate_cache()
        for address, mux in self._muxes.items():
            self.refused_address = address
            try:
                mux.write_mask(1)
                self.refused_address = None
                if mux.read_mask() == 1:
                    return True
            except NoAcknowledgeError:
                continue
        return False

    def _close(self, address: int) -> None:
        try:
            self._write(address, 0)
        except NoAcknowledgeError:
            self._refusals[address] += 1
            if self._refusals[address] < _REFUSALS_MAX:
                raise
            self.silent_addresses.add(address)
            self._masks[address] = 0

    def _write(self, address: int, mask: int) -> None:
        self._masks[address] = None  # not known until the STOP
        self.refused_address = address
        self._muxes[address].write_mask(mask)
        self.refused_address = None
        self._masks[address] = mask
        self._refusals[address] = 0
        self.silent_addresses.discard(address)
