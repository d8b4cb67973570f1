"""Driver of the Microchip MCP3208: analogue-to-digital converter, eight inputs, 12 bit, SPI.

Sources: data sheet DS21298E section 5, and hardware.md 6.
"""

from __future__ import annotations

from devices.buses.spi import SpiDevice
from devices.errors import AdcSilentError, SpiError

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
