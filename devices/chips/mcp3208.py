"""MCP3208 analog-to-digital converter, and the load cell of a calibration rig behind it.

Sources: data sheet DS21298E section 5, and hardware.md 6.

The scene gives the newtons per volt. The scale of the paper's sensor and amplifier is not known
(hardware.md 6), so there is no default.
"""

from __future__ import annotations

import math

from devices.buses.spi import SpiDevice
from devices.errors import AdcSilentError, SpiError
from devices.scene.hardware_sections import ReferenceSection

CHANNELS = range(8)

COUNTS_MAX = 4095
COUNTS_PER_VREF = 4096
"""Volts are counts * vref / 4096 (hardware.md 6)."""

_BYTES = 3
_START_SINGLE_ENDED = 0x06  # start bit, SGL/DIFF, and the place of D2
_NULL_BIT = 0x10  # in the second byte, before B11
_HIGH_BITS = 0x0F  # B11 to B8


class Mcp3208:
    """Driver of one converter, read single-ended.

    A transfer is three bytes. The place of the start bit puts the null bit and B11..B8 into the
    second byte and B7..B0 into the third. An MCP3008's framing puts them two bits later, and so
    loses the lowest two.
    """

    def __init__(self, device: SpiDevice, *, where: str) -> None:
        self._xfer2 = device.xfer2
        self._where = where
        # Tuples: spidev overwrites a list.
        self._requests = [
            (_START_SINGLE_ENDED | channel >> 2, (channel & 0b11) << 6, 0) for channel in CHANNELS
        ]

    def read_counts(self, channel: int) -> int:
        """Convert the voltage at input `channel`, 0 to 7, and return 0 to 4095 counts.

        The meaning of both end values depends on the connected circuit. A line stuck low has a
        valid null bit, and reads 0.

        Raises:
            AdcSilentError: the null bit is high, as on a line that floats.
            SpiError: the transfer failed.
        """
        try:
            received = self._xfer2(list(self._requests[channel]))
        except OSError as error:
            raise SpiError(
                f"the transfer failed ({error.strerror or error})",
                where=f"{self._where}, channel {channel}",
                remedy="Check that the device is still there",
            ) from error
        if len(received) != _BYTES:
            raise SpiError(
                f"the transfer was cut short ({len(received)} bytes came)",
                where=f"{self._where}, channel {channel}",
                expected=f"{_BYTES} bytes",
                remedy="Check the SPI controller's driver",
            )
        _, high, low = received
        if high & _NULL_BIT:
            raise AdcSilentError(
                f"no converter drives the line (received {high:02x} {low:02x})",
                where=f"{self._where}, channel {channel}",
                expected="a null bit before the result",
                remedy="Check the converter's supply, chip select, and DOUT to MISO",
            )
        return (high & _HIGH_BITS) << 8 | low


class ReferenceForceSensor:
    """Reference force sensor. A failed reading is NaN and never an exception."""

    def __init__(self, adc: Mcp3208, scene: ReferenceSection) -> None:
        self.failed_readings = 0
        """Number of failed readings: no transfer, or no converter."""
        self.saturated_readings = 0
        """Number of readings at either end of the converter's range, which are no force."""
        self.warning = ""
        """Reason why the last reading gave no force; empty if it gave one."""
        self._adc = adc
        self._channel = scene.channel
        self._zero_v = scene.zero_v
        self._n_per_v = scene.n_per_v
        self._volts_per_count = scene.vref_v / COUNTS_PER_VREF

    def read_force_n(self) -> float:
        """Convert now and return the force in newtons.

        NaN if the reading failed or is at either rail: an open, shorted or overloaded amplifier
        must never give a plausible force.
        """
        try:
            counts = self._adc.read_counts(self._channel)
        except SpiError as error:
            self.failed_readings += 1
            self.warning = f"no reference force: {error}"
            return math.nan
        if counts in (0, COUNTS_MAX):
            self.saturated_readings += 1
            self.warning = "no reference force: the amplifier is off, unplugged or overloaded"
            return math.nan
        self.warning = ""
        return (counts * self._volts_per_count - self._zero_v) * self._n_per_v
