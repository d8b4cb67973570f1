"""Opening an SPI device: its settings, its errors, its reopening."""

from __future__ import annotations

import errno
import os
import sys
from types import ModuleType

import pytest

from devices.buses.device_files import ATTEMPT_INTERVAL_NS
from devices.buses.spi import open_spi
from devices.errors import MissingExtraError, SpiSetupError, UsageError
from tests.waiting import until


class FakeSpiDev:
    """`spidev.SpiDev` without a device: attributes, and `open_path`."""

    mode = 3
    max_speed_hz = 125_000_000
    failure: OSError | None = None

    def __init__(self) -> None:
        self.path = ""
        self.closed = False
        self.is_unbound = False

    def open_path(self, path: str) -> None:
        if self.failure is not None:
            raise self.failure
        self.path = path

    def xfer2(self, data: list[int], /) -> list[int]:
        if self.is_unbound:
            raise OSError(errno.ESHUTDOWN, os.strerror(errno.ESHUTDOWN))
        return data

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> list[FakeSpiDev]:
    """Devices that a fake library has made."""
    made: list[FakeSpiDev] = []

    def make() -> FakeSpiDev:
        made.append(FakeSpiDev())
        return made[-1]

    library = ModuleType("spidev")
    library.SpiDev = make  # type: ignore[attr-defined]  # a module of our own
    monkeypatch.setitem(sys.modules, "spidev", library)
    return made


def test_a_device_is_opened_in_mode_0_at_1_mhz(devices: list[FakeSpiDev]) -> None:
    opened = open_spi("/dev/spidev0.1")
    assert opened.xfer2([1, 2, 3]) == [1, 2, 3]
    assert devices[0].path == "/dev/spidev0.1"
    # hardware.md 6: SPI mode 0,0; at 3.3 V stay at or below 1 MHz
    assert (devices[0].mode, devices[0].max_speed_hz) == (0, 1_000_000)
    assert not devices[0].closed


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EACCES])
def test_a_device_that_cannot_be_opened_is_closed_and_named(
    devices: list[FakeSpiDev], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr(FakeSpiDev, "failure", OSError(number, os.strerror(number)))
    with pytest.raises(SpiSetupError, match=os.strerror(number)) as caught:
        open_spi("/dev/spidev0.0")
    assert caught.value.where == "/dev/spidev0.0"
    assert "dtparam=spi=on" in caught.value.remedy
    assert devices[0].closed


def test_a_lost_device_is_closed_and_reopened_by_its_path(
    devices: list[FakeSpiDev], monkeypatch: pytest.MonkeyPatch
) -> None:
    now_ns = 0
    monkeypatch.setattr("devices.buses.spi.time.monotonic_ns", lambda: now_ns)
    opened = open_spi("/dev/spidev0.0")

    def transfer_error() -> str:
        try:
            opened.xfer2([0])
        except OSError as error:
            return str(error)
        return ""

    devices[0].is_unbound = True
    assert "shutdown" in transfer_error()
    assert devices[0].closed
    with monkeypatch.context() as patch:
        patch.setattr(FakeSpiDev, "failure", OSError(errno.EACCES, "Permission denied"))
        assert until(lambda: "group spi" in transfer_error())
    assert [device.closed for device in devices] == [True, True]
    now_ns = ATTEMPT_INTERVAL_NS
    until(lambda: not transfer_error())
    assert opened.xfer2([1, 2, 3]) == [1, 2, 3]
    assert (len(devices), devices[2].path) == (3, "/dev/spidev0.0")
    opened.close()
    assert devices[2].closed


def test_the_extra_is_named_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "spidev", None)
    with pytest.raises(MissingExtraError, match=r"'foottile\[rig\]'"):
        open_spi("/dev/spidev0.0")


def test_an_emulated_device_is_the_one_that_is_given(devices: list[FakeSpiDev]) -> None:
    emulated = FakeSpiDev()
    assert open_spi("emulated", emulated) is emulated
    assert open_spi("/dev/spidev0.0", emulated) is not emulated
    assert len(devices) == 1
    with pytest.raises(UsageError, match="emulated") as caught:
        open_spi("emulated")
    assert caught.value.exit_code == 2
