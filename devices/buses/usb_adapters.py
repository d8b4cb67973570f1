"""I2C adapters on USB: found by their USB ids, as their bus number changes with each plugging."""

from __future__ import annotations

import errno
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from devices.errors import BusSetupError, UsageError

SYSFS = Path("/sys/class/i2c-dev")
"""The kernel's I2C buses that have a device file (Documentation/i2c/dev-interface.rst)."""
PREFIX = "usb:"
_NAME = re.compile(r"usb:(?P<vendor>[0-9a-f]{4}):(?P<product>[0-9a-f]{4})(:(?P<serial>.+))?", re.I)


@dataclass(frozen=True)
class UsbAdapter:
    """An I2C adapter that is plugged in.

    Attributes:
        bus: its device file now, such as /dev/i2c-5.
        driver: name of the kernel's adapter.
        ids: USB vendor and product in hexadecimal, such as 1c40:0534.
        serial: its serial number; empty if it has none.
    """

    bus: str
    driver: str
    ids: str
    serial: str

    def __str__(self) -> str:
        """Return the words for a user."""
        return f"{self.driver}, {self.name}"

    @property
    def name(self) -> str:
        """Its name for `--bus` and a scene, which stays when its bus number changes."""
        return f"{PREFIX}{self.ids}" + (f":{self.serial}" if self.serial else "")


def find_usb_adapters() -> tuple[UsbAdapter, ...]:
    """Find the I2C adapters that are plugged in by USB."""
    adapters = []
    for bus in sorted(SYSFS.glob("i2c-*"), key=lambda path: int(path.name[4:])):
        with suppress(OSError):  # it is being unplugged
            device = (bus / "device").resolve(strict=True)
            usb = next((p for p in device.parents if (p / "idVendor").exists()), None)
            if usb is None:
                continue
            ids = ":".join(_read_line(usb / name) for name in ("idVendor", "idProduct"))
            serial = _read_line(usb / "serial") if (usb / "serial").exists() else ""
            driver = _read_line(device / "name")
            adapters.append(UsbAdapter(f"/dev/{bus.name}", driver, ids, serial))
    return tuple(adapters)


def find_bus_file(name: str) -> str:
    """Return the device file of a bus by its name.

    Of `usb:VENDOR:PRODUCT` or `usb:VENDOR:PRODUCT:SERIAL` it is that of the adapter with these ids,
    of any other name the name itself.

    Raises:
        UsageError: the name is no such name.
        BusSetupError: no adapter has these ids, or several have.
    """
    if not name.startswith(PREFIX):
        return name
    match = _NAME.fullmatch(name)
    if match is None:
        raise UsageError(
            f"bus {name!r}", expected="usb:VENDOR:PRODUCT, as usb:1c40:0534 in `lsusb`"
        )
    ids = f"{match['vendor']}:{match['product']}".lower()
    plugged = find_usb_adapters()
    found = [a for a in plugged if a.ids == ids and match["serial"] in (None, a.serial)]
    if len(found) == 1:
        return found[0].bus
    there = ", ".join(f"{adapter.name} at {adapter.bus}" for adapter in found or plugged)
    if found:
        raise BusSetupError(
            f"{len(found)} adapters have these ids: {there}",
            where=name,
            remedy="Unplug one, or add a serial number that only one has behind a colon",
        )
    raise BusSetupError(
        f"no I2C adapter with these ids is plugged in; plugged in: {there or 'none'}",
        where=name,
        remedy="Check `lsusb`, and that the modules of the adapter and i2c-dev are loaded "
        "(sudo modprobe i2c-dev)",
        errno=errno.ENOENT,
    )


def find_adapter(name: str) -> UsbAdapter | None:
    """Find the USB adapter of a bus; None if it is on no USB.

    Raises:
        BusSetupError: as `find_bus_file`.
    """
    file = str(Path(find_bus_file(name)).resolve())
    return next((adapter for adapter in find_usb_adapters() if adapter.bus == file), None)


def _read_line(path: Path) -> str:
    return path.read_text(errors="replace").strip()
