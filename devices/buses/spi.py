"""The SPI device as a driver sees it: one call, `xfer2`, which returns a bit for every bit sent.

On a Raspberry Pi that is `spidev.SpiDev`, in an emulation the bit-level model behind the same
method. Both raise bare `OSError`; the driver says what it means.
"""

from __future__ import annotations

from typing import Protocol

from devices.errors import SpiSetupError, UsageError, needs_extra

MAX_SPEED_HZ = 1_000_000
"""The highest clock for an MCP3208 at the Pi's 3.3 V (hardware.md 6)."""

MODE = 0
"""Clock idle low, bits taken at its rising edge: mode 0,0 of the MCP3208 data sheet."""

_INSTALL = "Install it: pip install 'foottile[rig]' (it is compiled, and needs gcc)"


class SpiDevice(Protocol):
    """What is beneath a driver: `spidev.SpiDev`, or an emulated device."""

    def xfer2(self, data: list[int], /) -> list[int]:
        """Exchange bytes while chip select stays low.

        spidev writes what it receives into `data` and returns that: a list to be sent again has to
        be copied.
        """

    def close(self) -> None:
        """Release the device."""


def open_spi(name: str, emulated: SpiDevice | None = None) -> SpiDevice:
    """Open the device `name`: a path such as `/dev/spidev0.0`, or `"emulated"`.

    An emulated device has to be handed in: the caller makes the world behind it.

    Raises:
        SpiSetupError: the device is missing or may not be opened.
        MissingExtraError: spidev is not installed.
        UsageError: `"emulated"` without an emulated device.
    """
    if name == "emulated":
        if emulated is None:
            raise UsageError("SPI device 'emulated' needs an emulated world, and none was given")
        return emulated
    with needs_extra("rig", f"the SPI device {name}", remedy=_INSTALL):
        from spidev import SpiDev
    device = SpiDev()
    try:
        device.open_path(name)
        device.mode = MODE
        device.max_speed_hz = MAX_SPEED_HZ
    except OSError as error:
        device.close()
        raise SpiSetupError(
            f"the SPI device cannot be used ({error.strerror or error})",
            where=name,
            remedy="Check that the device exists, that SPI is enabled (dtparam=spi=on) and that "
            "this user is in the group spi",
        ) from error
    opened: SpiDevice = device
    return opened
