"""The latency timer and the stable path of a serial adapter."""

from __future__ import annotations

from pathlib import Path

import pytest

from devices.buses.serial_line import check_latency_timer, find_stable_path, read_latency_timer_ms


@pytest.fixture
def sysfs(tmp_path: Path) -> Path:
    """A folder in place of sysfs, with an adapter and its timer of 16 ms."""
    (tmp_path / "ttyUSB7").mkdir()
    (tmp_path / "ttyUSB7" / "latency_timer").write_text("16\n")
    return tmp_path


def test_the_latency_timer_is_read_by_a_port_or_a_link_to_it(sysfs: Path) -> None:
    link = sysfs / "usb-FTDI_adapter-port0"
    link.symlink_to("/dev/ttyUSB7")
    for port in ("/dev/ttyUSB7", str(link)):
        assert read_latency_timer_ms(port, sysfs) == 16


@pytest.mark.parametrize("port", ["/dev/ttyAMA0", "/dev/pts/7", "ttyUSB8"])
def test_a_port_that_is_no_ftdi_adapter_has_no_timer(sysfs: Path, port: str) -> None:
    assert read_latency_timer_ms(port, sysfs) is None
    assert check_latency_timer(port, sysfs) is None


def test_a_timer_that_is_missing_or_no_number_is_none(sysfs: Path) -> None:
    assert read_latency_timer_ms("/dev/ttyUSB7", sysfs / "missing") is None
    (sysfs / "ttyUSB7" / "latency_timer").write_text("soon\n")
    assert read_latency_timer_ms("/dev/ttyUSB7", sysfs) is None


@pytest.mark.parametrize(("timer", "is_slow"), [("0", False), ("1", False), ("16", True)])
def test_a_slow_timer_is_a_warning_with_its_remedy(sysfs: Path, timer: str, is_slow: bool) -> None:
    (sysfs / "ttyUSB7" / "latency_timer").write_text(timer)
    warning = check_latency_timer("/dev/ttyUSB7", sysfs)
    assert (warning is not None) == is_slow
    if warning is not None:
        assert warning.startswith("/dev/ttyUSB7: ")
        for part in ("16 ms", "expected 1 ms", "udev", 'ATTR{latency_timer}="1"'):
            assert part in warning


def test_the_stable_path_of_a_port_is_its_link_by_id(tmp_path: Path) -> None:
    device, other, by_id = tmp_path / "ttyUSB0", tmp_path / "ttyUSB1", tmp_path / "by-id"
    assert find_stable_path(str(device), by_id) == str(device), "without udev"
    by_id.mkdir()
    for file in (device, other):
        file.touch()
    (by_id / "usb-another").symlink_to(other)
    assert find_stable_path(str(device), by_id) == str(device)
    link = by_id / "usb-FTDI_adapter-port0"
    link.symlink_to(device)
    for path in (device, link):
        assert find_stable_path(str(path), by_id) == str(link)
