"""SPI device for the drivers: one method, `xfer2`, which returns a bit for every bit sent.

`spidev.SpiDev` on a Raspberry Pi, a bit-level model in an emulation. Both raise bare `OSError`; the
driver interprets it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import time
from typing import Protocol

from devices.buses.device_files import DeviceReopener
from devices.errors import SpiSetupError, UsageError, require_extra

MAX_SPEED_HZ = 1_000_000
"""The highest clock for an MCP3208 at the Pi's 3.3 V (hardware.md 6)."""

MODE = 0
"""Clock idle low, bits taken at its rising edge: mode 0,0 of the MCP3208 data sheet."""

_INSTALL = "Install it: pip install 'foottile[rig]' (it is compiled, and needs gcc)"


class SpiDevice(Protocol):
    """Device beneath a driver: `spidev.SpiDev`, or an emulated one."""

    def xfer2(self, data: list[int], /) -> list[int]:
        """Exchange bytes while chip select stays low.

        spidev writes the received bytes into `data` and returns it: copy a list before reuse.
        """

    def close(self) -> None:
        """Release the device."""


class SpiPort:
    """SPI device by its path, reopened after it went away (its driver was unbound)."""

    def __init__(self, device: SpiDevice, reopener: DeviceReopener[SpiDevice]) -> None:
        self._device: SpiDevice | None = device
        self._reopener = reopener

    def xfer2(self, data: list[int], /) -> list[int]:
        """Exchange bytes as `SpiDevice.xfer2`; reopen a device that was away.

        Raises:
            OSError: the transfer failed, or the device is away.
        """
        if self._device is None:
            self._device = self._reopener.poll_opened_device(time.monotonic_ns())
        if self._device is None:
            raise OSError(errno.ENODEV, self._reopener.last_error or os.strerror(errno.ENODEV))
        try:
            return self._device.xfer2(data)
        except OSError:
            # A transfer of three bytes fails only if the device is away.
            device, self._device = self._device, None
            with contextlib.suppress(OSError):
                device.close()
            raise

    def close(self) -> None:
        """Release the device."""
        self._reopener.close()
        if self._device is not None:
            self._device.close()


def open_spi(name: str, emulated: SpiDevice | None = None) -> SpiDevice:
    """Open the device `name`: a path such as `/dev/spidev0.0`, or `"emulated"`.

    The caller creates and passes the emulated device.

    Raises:
        SpiSetupError: the device is missing or may not be opened.
        MissingExtraError: spidev is not installed.
        UsageError: `"emulated"` without an emulated device.
    """
    if name == "emulated":
        if emulated is None:
            raise UsageError("SPI device 'emulated' needs an emulated world, and none was given")
        return emulated
    return SpiPort(_open_device(name), DeviceReopener(lambda: _open_device(name)))


def _open_device(name: str) -> SpiDevice:
    with require_extra("rig", f"the SPI device {name}", remedy=_INSTALL):
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
