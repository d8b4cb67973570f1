"""USB adapters are found by their ids, whatever number the kernel gives their bus."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from devices.buses import usb_adapters
from devices.buses.i2c import open_bus
from devices.buses.usb_adapters import find_adapter, find_bus_file, find_usb_adapters
from devices.errors import BusSetupError, UsageError


class Sysfs:
    """The kernel's files of I2C buses (seen of i2c-tiny-usb and of a Pi's own controller)."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self.buses = root / "class" / "i2c-dev"
        self.buses.mkdir(parents=True)

    def add(self, number: int, device: str, name: str) -> Path:
        """Add a bus of a device."""
        bus = self._root / "devices" / device / f"i2c-{number}"
        bus.mkdir(parents=True)
        (bus / "name").write_text(f"{name}\n")
        (self.buses / f"i2c-{number}").mkdir()
        (self.buses / f"i2c-{number}" / "device").symlink_to(bus)
        return bus

    def plug(self, number: int, port: str, ids: str, serial: str = "") -> None:
        """Plug in a USB adapter."""
        bus = self.add(number, f"pci0/usb1/{port}/{port}:1.0", "i2c-tiny-usb at bus 001")
        usb = bus.parents[1]
        for name, value in zip(("idVendor", "idProduct"), ids.split(":"), strict=True):
            (usb / name).write_text(f"{value}\n")
        if serial:
            (usb / "serial").write_text(f"{serial}\n")

    def unplug(self, number: int) -> None:
        """Pull it out; what is open of it stays."""
        (self.buses / f"i2c-{number}" / "device").unlink()
        (self.buses / f"i2c-{number}").rmdir()


@pytest.fixture
def sysfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sysfs:
    files = Sysfs(tmp_path)
    files.add(1, "platform/soc/fe804000.i2c", "bcm2835 (i2c@7e804000)")
    monkeypatch.setattr(usb_adapters, "SYSFS", files.buses)
    return files


def test_the_name_follows_an_adapter_to_another_number(sysfs: Sysfs) -> None:
    sysfs.plug(0, "1-1", "1c40:0534")
    assert find_bus_file("usb:1C40:0534") == "/dev/i2c-0"
    sysfs.unplug(0)
    sysfs.plug(10, "1-2", "1c40:0534")
    assert find_bus_file("usb:1c40:0534") == "/dev/i2c-10"
    (adapter,) = find_usb_adapters()
    assert find_adapter(adapter.name) == find_adapter("/dev/i2c-10") == adapter
    assert find_adapter("/dev/i2c-1") is None  # the Pi's own


def test_two_of_a_kind_are_told_apart_by_their_serial_numbers(sysfs: Sysfs) -> None:
    sysfs.plug(2, "1-1", "10c4:ea90", "left")
    sysfs.plug(3, "1-2", "10c4:ea90", "right:2")
    with pytest.raises(BusSetupError, match=r"usb:10c4:ea90:left at /dev/i2c-2, .*:right:2 at"):
        find_bus_file("usb:10c4:ea90")
    assert find_bus_file("usb:10c4:ea90:right:2") == "/dev/i2c-3"


def test_an_adapter_that_is_not_plugged_in_is_said(sysfs: Sysfs) -> None:
    sysfs.plug(2, "1-1", "10c4:ea90")
    with pytest.raises(BusSetupError, match="plugged in: usb:10c4:ea90 at /dev/i2c-2") as missing:
        open_bus("usb:1c40:0534")
    assert missing.value.errno == errno.ENOENT


@pytest.mark.parametrize("name", ["usb:", "usb:1c40", "usb:1c40:xyz1", "usb:1c40:0534:"])
def test_a_name_that_is_none_is_refused(sysfs: Sysfs, name: str) -> None:
    with pytest.raises(UsageError, match="usb:1c40:0534"):
        find_bus_file(name)
