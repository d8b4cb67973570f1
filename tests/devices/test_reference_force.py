"""The reference force: volts to newtons, and NaN wherever it could be wrong."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from devices.buses.spi import SpiDevice
from devices.chips.mcp3208 import Mcp3208
from devices.clock import VirtualClock
from devices.emulation.chips.mcp3208 import EmulatedMcp3208, InputVoltages, make_amplifier
from devices.reference_force import ReferenceForceSensor
from devices.scene.hardware_sections import ReferenceSection

SCENE = ReferenceSection(channel=3, zero_v=1.65, n_per_v=100 / 3.3)


def reference(device: SpiDevice, scene: ReferenceSection = SCENE) -> ReferenceForceSensor:
    return ReferenceForceSensor(Mcp3208(device, where="rig"), scene)


def connected(volts: InputVoltages) -> EmulatedMcp3208:
    return EmulatedMcp3208(volts, VirtualClock())


class Dead:
    """A device with the transfers of `exchange`."""

    def __init__(self, exchange: Callable[[list[int]], list[int]]) -> None:
        self.xfer2 = exchange

    def close(self) -> None:
        pass


@pytest.mark.parametrize("force_n", [-49.9, -3.21, 0.0, 0.05, 30.0, 49.9])
def test_a_force_is_read_within_half_a_count(force_n: float) -> None:
    sensor = reference(connected(make_amplifier(lambda t_ns: force_n, SCENE)))
    assert sensor.read_force_n() == pytest.approx(force_n, abs=0.5 * 100 / 4096 + 1e-9)
    assert (sensor.failed_readings, sensor.saturated_readings) == (0, 0)


def test_a_scale_may_be_negative_and_a_reference_voltage_another() -> None:
    scene = ReferenceSection(channel=0, vref_v=5.0, zero_v=4.0, n_per_v=-8.0)
    volts = make_amplifier(lambda t_ns: 20.0, scene)
    device = EmulatedMcp3208(volts, VirtualClock(), vref_v=5.0)
    assert reference(device, scene).read_force_n() == pytest.approx(20.0, abs=0.005)


@pytest.mark.parametrize("volts", [-10.0, 0.0, 3.2999, 10.0])
def test_an_amplifier_at_a_rail_gives_no_force_and_a_warning_until_it_is_repaired(
    volts: float,
) -> None:
    at_input = [volts]
    sensor = reference(connected(lambda channel, t_ns: at_input[0]))
    assert math.isnan(sensor.read_force_n())
    assert (sensor.failed_readings, sensor.saturated_readings) == (0, 1)
    assert "amplifier" in sensor.warning
    at_input[0] = 1.65
    assert sensor.read_force_n() == pytest.approx(0.0, abs=0.02)
    assert sensor.warning == ""


@pytest.mark.parametrize("counts", [1, 4094])
def test_the_last_counts_before_the_rails_are_forces(counts: int) -> None:
    volts = counts * 3.3 / 4096
    sensor = reference(connected(lambda channel, t_ns: volts))
    assert sensor.read_force_n() == pytest.approx((volts - 1.65) * 100 / 3.3)


def unplugged(data: list[int]) -> list[int]:
    raise OSError(19, "No such device")


@pytest.mark.parametrize("exchange", [unplugged, lambda data: [0xFF] * len(data)])
def test_a_failed_reading_is_counted_and_is_no_force(
    exchange: Callable[[list[int]], list[int]],
) -> None:
    sensor = reference(Dead(exchange))
    assert math.isnan(sensor.read_force_n())
    assert math.isnan(sensor.read_force_n())
    assert (sensor.failed_readings, sensor.saturated_readings) == (2, 0)
    assert sensor.warning.startswith("no reference force: rig, channel 3: ")
