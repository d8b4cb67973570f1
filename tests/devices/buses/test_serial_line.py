"""The latency timer of an adapter, with a folder in place of sysfs."""

from __future__ import annotations

from pathlib import Path

import pytest

from devices.buses.serial_line import check_latency_timer, find_stable_path, read_latency_timer_ms


def adapter(sysfs: Path, content: str) -> None:
    (sysfs / "ttyUSB7").mkdir()
    (sysfs / "ttyUSB7" / "latency_timer").write_text(content)


def test_the_latency_timer_is_read_from_sysfs(tmp_path: Path) -> None:
    adapter(tmp_path, "16\n")
    assert read_latency_timer_ms("/dev/ttyUSB7", tmp_path) == 16


def test_a_link_to_the_port_is_followed(tmp_path: Path) -> None:
    adapter(tmp_path, "4\n")
    link = tmp_path / "usb-FTDI_adapter-port0"
    link.symlink_to("/dev/ttyUSB7")
    assert read_latency_timer_ms(str(link), tmp_path) == 4


@pytest.mark.parametrize("port", ["/dev/ttyAMA0", "/dev/pts/7", "ttyUSB8"])
def test_a_port_that_is_no_ftdi_adapter_has_no_timer(tmp_path: Path, port: str) -> None:
    adapter(tmp_path, "16\n")
    assert read_latency_timer_ms(port, tmp_path) is None
    assert check_latency_timer(port, tmp_path) is None


def test_a_machine_without_usb_serial_has_no_timer(tmp_path: Path) -> None:
    assert read_latency_timer_ms("/dev/ttyUSB7", tmp_path / "not there") is None


def test_a_timer_that_says_no_number_is_none(tmp_path: Path) -> None:
    adapter(tmp_path, "soon\n")
    assert read_latency_timer_ms("/dev/ttyUSB7", tmp_path) is None


def test_a_slow_timer_is_remarked_on_with_the_remedy(tmp_path: Path) -> None:
    adapter(tmp_path, "16\n")
    remark = check_latency_timer("/dev/ttyUSB7", tmp_path)
    assert remark is not None
    assert remark.startswith("/dev/ttyUSB7: ")
    for part in ("16 ms", "expected 1 ms", "udev", 'ATTR{latency_timer}="1"'):
        assert part in remark


@pytest.mark.parametrize("timer", ["0", "1"])
def test_a_quick_timer_is_not(tmp_path: Path, timer: str) -> None:
    adapter(tmp_path, timer)
    assert check_latency_timer("/dev/ttyUSB7", tmp_path) is None


def test_the_name_that_lasts_is_udevs_link_to_the_adapter(tmp_path: Path) -> None:
    device, other, by_id = tmp_path / "ttyUSB0", tmp_path / "ttyUSB1", tmp_path / "by-id"
    by_id.mkdir()
    for file in (device, other):
        file.touch()
    (by_id / "usb-another").symlink_to(other)
    assert find_stable_path(str(device), by_id) == str(device)
    link = by_id / "usb-FTDI_adapter-port0"
    link.symlink_to(device)
    assert find_stable_path(str(device), by_id) == str(link)
    assert find_stable_path(str(link), by_id) == str(link)


def test_without_udev_a_port_keeps_its_own_name(tmp_path: Path) -> None:
    assert find_stable_path("/dev/ttyUSB0", tmp_path / "by-id") == "/dev/ttyUSB0"
