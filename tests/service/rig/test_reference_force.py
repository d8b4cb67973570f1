"""The reference force: volts to newtons, and NaN wherever it could be wrong."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from devices.buses.spi import SpiDevice, open_spi
from devices.chips.mcp3208 import Mcp3208
from devices.clock import VirtualClock
from devices.emulation.chips.mcp3208 import EmulatedMcp3208, InputVoltages, make_amplifier
from devices.emulation.world import World
from devices.scene.hardware_sections import ReferenceSection
from service.rig.rig import ReferenceForceSensor
from tests.builders.scenes import make_scene

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
    assert sensor.warning == ""


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
def test_a_failed_reading_is_no_force_and_a_warning(
    exchange: Callable[[list[int]], list[int]],
) -> None:
    sensor = reference(Dead(exchange))
    assert math.isnan(sensor.read_force_n())
    assert math.isnan(sensor.read_force_n())
    assert sensor.warning.startswith("no reference force: rig, channel 3: ")


# The force sensor of the indenter behind its emulated converter

PLUS_MINUS_50_N = ReferenceSection(zero_v=1.65, n_per_v=100 / 3.3)


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock(7_000_000_000)


@pytest.fixture
def world(clock: VirtualClock) -> World:
    return World(make_scene(((0x70, 0), (0x70, 1)), ground={"kind": "indentation"}), clock)


def sensor_of(world: World, clock: VirtualClock, scene: ReferenceSection) -> ReferenceForceSensor:
    assert world.indenter is not None
    device = open_spi(scene.port, world.indenter.make_adc(scene, clock))
    return ReferenceForceSensor(Mcp3208(device, where=scene.port), scene)


def test_the_force_through_the_converter_is_that_of_the_spindle(
    world: World, clock: VirtualClock
) -> None:
    sensor = sensor_of(world, clock, PLUS_MINUS_50_N)
    clock.sleep_until_ns(world.epoch_ns + 500_000_000)
    assert sensor.read_force_n() == pytest.approx(0.0, abs=0.15), "before the first stroke"
    # The first stroke of 4 s to 30 N begins after the lead of 1 s and 0.3 s of rest.
    begins_ns = world.epoch_ns + np.linspace(1.31e9, 5.29e9, 2_000).astype(np.int64)
    measured = []
    for begin_ns in begins_ns:
        clock.sleep_until_ns(int(begin_ns))
        measured.append(sensor.read_force_n())
    true = world.compute_truth(begins_ns + 11_000).true_force_n[:, 0]  # the sampling clock
    error = np.array(measured) - true
    assert abs(error.mean()) < 0.005
    assert 0.005 < error.std() < 0.05
    steps = np.array(measured) / (100 / 4096)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.diff(np.unique(np.round(steps))).min() == 1


def test_a_force_beyond_the_range_of_the_converter_is_unknown(
    world: World, clock: VirtualClock
) -> None:
    scene = ReferenceSection(zero_v=1.65, n_per_v=10.0)  # +-16.5 N, and the stroke goes to 30 N
    sensor = sensor_of(world, clock, scene)
    clock.sleep_until_ns(world.epoch_ns + 1_300_000_000 + 2_000_000_000)
    assert sensor.read_force_n() == pytest.approx(15.0, abs=0.2)
    clock.sleep_until_ns(world.epoch_ns + 1_300_000_000 + 3_000_000_000)
    assert np.isnan(sensor.read_force_n())
    assert "amplifier" in sensor.warning
