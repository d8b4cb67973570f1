"""Vitals from files as a Raspberry Pi has them, and warnings that do not flicker."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.realtime import ClockState
from devices.vitals import Vitals, VitalsWarnings, read_vitals

WIRELESS = """Inter-| sta-|   Quality        |   Discarded packets               | Missed | WE
 face | tus | link level noise |  nwid  crypt   frag  retry   misc | beacon | 22
 wlan0: 0000   54.  -56.  -256        0      0      0      0    148        0
 wlan1: 0000   20.  -81.  -256        0      0      0      0      0        0
"""
ROUTES = "Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\tMTU\tWindow\tIRTT\n"


def route(interface: str, metric: int, destination: str = "00000000") -> str:
    return f"{interface}\t{destination}\t0100A8C0\t0003\t0\t0\t{metric}\t00000000\t0\t0\t0\n"


class Pi:
    """Files of a Raspberry Pi below a folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def write(self, path: str, text: str) -> None:
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)

    def vcgencmd(self, script: str) -> None:
        self.write("usr/bin/vcgencmd", f"#!/bin/sh\n{script}\n")
        (self.root / "usr/bin/vcgencmd").chmod(0o755)

    def read(self, **rest: Any) -> Vitals:
        return read_vitals(None, root=self.root, **rest)


@pytest.fixture
def pi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pi:
    monkeypatch.setattr("devices.vitals.read_clock_state", lambda: None)
    return Pi(tmp_path)


def test_a_machine_that_states_nothing_has_no_values(pi: Pi) -> None:
    assert pi.read() == Vitals()


def test_this_machine_can_be_read(tmp_path: Path) -> None:
    vitals = read_vitals(tmp_path / "not" / "yet", 1000.0)
    assert vitals.disk_free_bytes is not None
    assert vitals.recording_left_s == vitals.disk_free_bytes / 1000
    assert vitals.load_per_core is not None


def test_the_temperature_is_the_cpus(pi: Pi) -> None:
    pi.write("sys/class/thermal/thermal_zone0/type", "acpitz\n")
    pi.write("sys/class/thermal/thermal_zone0/temp", "20000\n")
    assert pi.read().cpu_celsius == 20.0
    pi.write("sys/class/thermal/thermal_zone1/type", "cpu-thermal\n")
    pi.write("sys/class/thermal/thermal_zone1/temp", "54530\n")
    assert pi.read().cpu_celsius == 54.53


@pytest.mark.parametrize(
    ("said", "now", "was"),
    [
        ("throttled=0x0", (False, False), (False, False)),
        ("throttled=0x1", (True, False), (False, False)),
        ("throttled=0x50005", (True, True), (True, True)),
        ("throttled=0x50000", (False, False), (True, True)),
        ("throttled=0x80008", (False, True), (False, True)),
        ("throttled=0x20002", (False, True), (False, True)),
    ],
)
def test_the_firmwares_bits_say_now_and_since_the_start(
    pi: Pi, said: str, now: tuple[bool, bool], was: tuple[bool, bool]
) -> None:
    pi.vcgencmd(f"echo {said}")
    found = pi.read()
    assert (found.is_undervolted, found.is_throttled) == now
    assert (found.was_undervolted, found.was_throttled) == was


def test_without_the_command_files_of_the_kernel_are_read(pi: Pi) -> None:
    pi.vcgencmd("echo 'VCHI initialization failed'; exit 255")
    pi.write("sys/class/hwmon/hwmon0/name", "cpu_thermal\n")
    pi.write("sys/class/hwmon/hwmon1/name", "rpi_volt\n")
    pi.write("sys/class/hwmon/hwmon1/in0_lcrit_alarm", "1\n")
    assert pi.read() == Vitals(is_undervolted=True)
    pi.write("sys/devices/platform/soc/soc:firmware/get_throttled", "50000\n")
    found = pi.read()
    assert (found.is_undervolted, found.was_undervolted) == (False, True)


def test_load_is_per_core(pi: Pi) -> None:
    pi.write("proc/loadavg", "3.00 1.00 0.50 2/150 4242\n")
    assert pi.read().load_per_core is None
    for name in ("cpu0", "cpu1", "cpu2", "cpu3", "cpufreq"):
        (pi.root / "sys/devices/system/cpu" / name).mkdir(parents=True)
    assert pi.read().load_per_core == 0.75


def test_the_signal_is_that_of_the_interface_in_use(pi: Pi) -> None:
    pi.write("proc/net/wireless", WIRELESS)
    assert pi.read().wifi_dbm == -56.0, "a network of its own has no default route"
    pi.write("proc/net/route", ROUTES + route("wlan0", 600) + route("wlan1", 100))
    assert pi.read().wifi_dbm == -81.0
    pi.write("proc/net/route", ROUTES + route("wlan0", 600) + route("eth0", 100))
    assert pi.read().wifi_dbm is None
    pi.write("proc/net/wireless", WIRELESS.replace("-56.", "  0."))
    pi.write("proc/net/route", ROUTES + route("wlan0", 600))
    assert pi.read().wifi_dbm is None, "no link"


def test_files_that_say_something_else_are_no_values(pi: Pi) -> None:
    pi.vcgencmd(r"printf 'throttled=\377'")
    pi.write("proc/net/wireless", WIRELESS)
    odd = route("wlan1", 0).replace("\t0\t0\t0\t", "\t0\t0\tmany\t")
    pi.write("proc/net/route", ROUTES + odd + "x\n" + route("wlan0", 1))
    vitals = pi.read()
    assert (vitals.is_undervolted, vitals.wifi_dbm) == (None, -56.0)


def test_the_clock_is_as_the_kernel_states_it(pi: Pi, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("devices.vitals.read_clock_state", lambda: ClockState(True, 0.0125))
    found = pi.read()
    assert (found.is_clock_synchronised, found.clock_error_max_s) == (True, 0.0125)


# --- warnings -------------------------------------------------------------------------------------

BAD: list[tuple[str, Any, Any, str]] = [
    ("recording_left_s", 3000.0, 8000.0, "free space"),
    ("cpu_celsius", 81.0, 60.0, "cool it"),
    ("is_undervolted", True, False, "use a 5 V 3 A supply and a short cable"),
    ("was_undervolted", True, False, "since the machine was started"),
    ("is_throttled", True, False, "slowed down by heat or supply"),
    ("wifi_dbm", -80.0, -60.0, "access point"),
]


@pytest.mark.parametrize(("name", "bad", "good", "words"), BAD)
@given(states=st.lists(st.sampled_from(["bad", "good", "unknown"]), max_size=60))
def test_a_warning_begins_at_once_and_ends_after_half_a_minute(
    name: str, bad: Any, good: Any, words: str, states: list[str]
) -> None:
    warnings = VitalsWarnings()
    values = {"bad": bad, "good": good, "unknown": None}
    for n, state in enumerate(states):
        texts = warnings.update(Vitals(**{name: values[state]}))
        recent = states[max(0, n - 5) : n + 1]
        assert bool(texts) == ("bad" in recent)
        assert all(words in text for text in texts)


@given(levels=st.lists(st.floats(75.1, 79.9), min_size=1, max_size=40))
def test_between_the_thresholds_a_warning_stays_as_it_is(levels: list[float]) -> None:
    cool, hot = VitalsWarnings(), VitalsWarnings()
    hot.update(Vitals(cpu_celsius=85.0))
    for celsius in levels:
        assert cool.update(Vitals(cpu_celsius=celsius)) == ()
        assert len(hot.update(Vitals(cpu_celsius=celsius))) == 1


def test_a_sag_now_is_not_said_twice() -> None:
    warnings = VitalsWarnings()
    (text,) = warnings.update(Vitals(is_undervolted=True, was_undervolted=True))
    assert "sags" in text
    past = Vitals(is_undervolted=False, was_undervolted=True)
    (text,) = [warnings.update(past) for _ in range(7)][-1]
    assert "has sagged" in text


def test_healthy_vitals_are_silent() -> None:
    good = Vitals(**{name: value for name, _, value, _ in BAD})
    warnings = VitalsWarnings()
    assert all(warnings.update(good) == () for _ in itertools.repeat(None, 20))
