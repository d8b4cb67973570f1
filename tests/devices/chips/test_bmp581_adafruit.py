"""The emulated BMP581 as Adafruit's driver reads it, over our bus, and as ours does."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import product
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from devices.buses.i2c import I2cBus, i2c_msg
from devices.chips.bmp581 import BMP581, OVERSAMPLINGS
from devices.chips.pressure_chip import ChipSettings
from devices.errors import NoAcknowledgeError
from tests.devices.chips.test_bmp581 import PART_ID, Bench

BOARD_MODULES = ("busio", "circuitpython_typing", "digitalio")
"""Modules of Adafruit's board support, of which the driver has the names of types only."""
ADAFRUIT = ("adafruit_bmp5xx", "adafruit_bus_device", "adafruit_register")


class CircuitPythonBus:
    """Our bus with the methods of CircuitPython's, which Adafruit's drivers call."""

    def __init__(self, bus: I2cBus) -> None:
        self._bus = bus

    def try_lock(self) -> bool:
        return True

    def unlock(self) -> None:
        pass

    def writeto(self, address: int, buffer: bytes, *, start: int = 0, end: int = 0) -> None:
        try:
            self._bus.transfer(i2c_msg.write(address, buffer[start:end]))
        except NoAcknowledgeError as error:
            raise OSError from error

    def writeto_then_readfrom(self, address: int, sent: bytes, received: Any, **_: int) -> None:
        message = i2c_msg.read(address, len(received))
        self._bus.transfer(i2c_msg.write(address, sent), message)
        received[:] = bytes(message)


@pytest.fixture
def adafruit(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Return Adafruit's module; boards, which the bus stands in for, are not installed."""
    for name in BOARD_MODULES:
        monkeypatch.setitem(sys.modules, name, MagicMock())
    monkeypatch.setitem(sys.modules, "circuitpython_typing.device_drivers", MagicMock())
    monkeypatch.setitem(sys.modules, "micropython", SimpleNamespace(const=int))
    import adafruit_bmp5xx

    yield adafruit_bmp5xx
    for name in [name for name in sys.modules if name.startswith(ADAFRUIT)]:
        del sys.modules[name]


def make_drifting_bench() -> Bench:
    """Make a bench at which no two conversions are equal, some of them colder than 0 degC."""
    return Bench(lambda t_ns: (95.0 + 2e-8 * t_ns % 20.0, 1e-6 * t_ns % 13.0 - 6.0))


def open_driver(adafruit: ModuleType, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Start Adafruit's driver in the time of a bench."""
    waits = SimpleNamespace(
        sleep=lambda s: bench.wait_ms(1e3 * s), monotonic=lambda: 1e-9 * bench.clock.now_ns()
    )
    monkeypatch.setattr(adafruit, "time", waits)
    return adafruit.BMP5XX.over_i2c(CircuitPythonBus(bench.bus), 0x46)


def assert_same_readings(theirs: Any, bench: Bench) -> None:
    """Check one conversion's words in both drivers, alone and together, bit for bit."""
    degc, hpa = theirs.measurements
    assert (theirs.temperature, theirs.pressure) == (degc, hpa)
    pressure_raw, temperature_raw = bench.driver.read_counts()
    assert bench.driver.read_pressure() == pressure_raw
    assert bench.driver.read_temperature() == temperature_raw
    assert BMP581.estimate_degc(temperature_raw) == degc
    assert pressure_raw / 64.0 / 100.0 == hpa
    law = BMP581.make_law((0x5032, *PART_ID))
    assert float(law.compute_kpa(pressure_raw, temperature_raw)) == pytest.approx(
        hpa / 10.0, rel=2e-16
    ), "the last bit of a product with 1/64000"
    assert bench.driver.classify_counts(pressure_raw, temperature_raw) == 0


@pytest.mark.parametrize(
    ("mode", "oversampling"),
    [("NORMAL", None), *product(["NORMAL", "FORCED", "CONTINOUS"], [1, 4, 32])],
)
def test_both_drivers_read_the_same_from_a_part_that_adafruits_set_up(
    adafruit: ModuleType, monkeypatch: pytest.MonkeyPatch, mode: str, oversampling: int | None
) -> None:
    bench = make_drifting_bench()
    theirs = open_driver(adafruit, bench, monkeypatch)
    if oversampling is not None:  # else as its constructor leaves it, with a filter
        theirs.mode = adafruit.BMP5XX_POWERMODE_STANDBY
        theirs.pressure_iir_filter = theirs.temperature_iir_filter = 0
        theirs.pressure_oversampling_rate = OVERSAMPLINGS.index(oversampling)
        theirs.mode = getattr(adafruit, f"BMP5XX_POWERMODE_{mode}")
    found = set()
    for _ in range(20):
        while not theirs.data_ready:
            assert bench.clock.now_ns() < 10**10
        assert_same_readings(theirs, bench)
        found.add(theirs.measurements)
        if mode == "FORCED":
            theirs.mode = adafruit.BMP5XX_POWERMODE_FORCED
    assert len(found) == 20, "each is a new conversion"
    assert min(degc for degc, _ in found) < 0.0 < max(degc for degc, _ in found)


@pytest.mark.parametrize(
    "settings", [ChipSettings(), ChipSettings(oversampling=8), ChipSettings(filter=3)]
)
def test_both_drivers_read_the_same_from_a_part_that_ours_set_up(
    adafruit: ModuleType, monkeypatch: pytest.MonkeyPatch, settings: ChipSettings
) -> None:
    bench = make_drifting_bench()
    theirs = open_driver(adafruit, bench, monkeypatch)
    bench.driver.start_up(BMP581.encode_settings(settings))
    bench.driver.has_new_counts()
    for _ in range(20):
        while not bench.driver.has_new_counts():
            assert bench.clock.now_ns() < 10**10
        assert_same_readings(theirs, bench)
        assert bench.driver.read_new_pressures(2)[-1] / 64.0 / 100.0 == theirs.pressure
