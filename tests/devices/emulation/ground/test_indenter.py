"""The force sensor of the indenter behind its emulated converter."""

from __future__ import annotations

import numpy as np
import pytest

from devices.buses.spi import open_spi
from devices.chips.mcp3208 import Mcp3208
from devices.clock import VirtualClock
from devices.emulation.world import World
from devices.reference_force import ReferenceForceSensor
from devices.scene.hardware_sections import ReferenceSection
from tests.builders.scenes import make_scene

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
    assert sensor.saturated_readings == 1
