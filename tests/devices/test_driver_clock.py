"""The driver's clock does not include the time that the emulation takes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.array.startup import prepare_array
from devices.buses.i2c import i2c_msg, open_bus
from devices.clock import LAG_MAX_NS, Clock, DriverClock, VirtualClock, WireClock
from devices.emulation.world import World
from devices.scene.scene_file import load_scene
from tests.builders.scenes import make_scene

ONE = ((0x70, 0),)
SELECT = i2c_msg.write(0x70, [1])
SELECT_NS = 50_000  # 20 bits at 400 kHz


class Host(VirtualClock):
    """The clock of a machine on which every wait ends late."""

    def __init__(self, late_ns: int = 0) -> None:
        super().__init__(1_000_000_000)
        self.late_ns = late_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        if t_ns > self.now_ns():
            super().sleep_until_ns(t_ns + self.late_ns)

    def compute(self, took_ns: int) -> None:
        super().sleep_until_ns(self.now_ns() + took_ns)


def hosted(late_ns: int = 0) -> tuple[Host, DriverClock, WireClock]:
    host = Host(late_ns)
    driver = DriverClock(host)
    return host, driver, WireClock(driver, host)


def test_a_transfer_takes_its_time_on_the_wire_on_a_late_machine() -> None:
    host, driver, wires = hosted(late_ns=60_000)
    world = World(make_scene(ONE), wires, begins_now=False)
    begin_ns = driver.now_ns()
    for _ in range(20):
        world.i2c_adapter.i2c_rdwr(SELECT)
    assert driver.now_ns() - begin_ns == 20 * SELECT_NS
    assert host.now_ns() - begin_ns < 20 * SELECT_NS + 2 * 60_000


def test_no_transfer_is_over_on_the_machine_before_its_bits_have_passed() -> None:
    host, driver, wires = hosted()
    world = World(make_scene(ONE), wires, begins_now=False)
    for took_ns in (0, 400_000, 0, 0, 0, 0, 0, 0, 0, 0, 0, 30_000):
        begin_ns = driver.now_ns()
        world.i2c_adapter.i2c_rdwr(SELECT)
        assert driver.now_ns() == begin_ns + SELECT_NS
        assert host.now_ns() >= begin_ns + SELECT_NS
        host.compute(took_ns)


def test_the_time_between_two_transfers_is_the_drivers() -> None:
    host, driver, wires = hosted()
    world = World(make_scene(ONE), wires, begins_now=False)
    world.i2c_adapter.i2c_rdwr(SELECT)
    before_ns = driver.now_ns()
    host.compute(77_000)
    assert driver.now_ns() == before_ns + 77_000


def test_a_driver_that_wakes_late_from_its_own_wait_is_late() -> None:
    host, driver, _ = hosted(late_ns=60_000)
    t_ns = driver.now_ns() + 1_000_000
    driver.sleep_until_ns(t_ns)
    assert driver.now_ns() == host.now_ns() == t_ns + 60_000


@given(computed_ns=st.integers(0, LAG_MAX_NS), wait_ns=st.integers(0, 2 * LAG_MAX_NS))
def test_a_wait_of_the_driver_is_shorter_by_the_lag_of_the_emulation(
    computed_ns: int, wait_ns: int
) -> None:
    host, driver, wires = hosted()
    end_ns = wires.now_ns()
    host.compute(computed_ns)
    wires.sleep_until_ns(end_ns)
    assert driver.now_ns() == end_ns
    driver.sleep_until_ns(end_ns + wait_ns)
    assert driver.now_ns() == end_ns + wait_ns
    assert host.now_ns() == end_ns + max(computed_ns, wait_ns)


def test_an_emulation_that_lags_too_far_makes_its_driver_late() -> None:
    host, driver, wires = hosted()
    end_ns = wires.now_ns()
    host.compute(LAG_MAX_NS + 5_000_000)
    wires.sleep_until_ns(end_ns)
    assert driver.now_ns() == end_ns + 5_000_000


@given(
    steps=st.lists(
        st.tuples(st.sampled_from(["transfer", "wait", "compute"]), st.integers(0, 3 * LAG_MAX_NS))
    ),
    late_ns=st.integers(0, 1_000_000),
)
def test_the_clock_of_the_driver_never_goes_back_nor_ahead_of_the_machine(
    steps: list[tuple[str, int]], late_ns: int
) -> None:
    host, driver, wires = hosted(late_ns)
    before_ns = driver.now_ns()
    for kind, ns in steps:
        begin_ns = driver.now_ns()
        if kind == "transfer":
            host.compute(ns // 2)
            wires.sleep_until_ns(begin_ns + ns // 3)
        elif kind == "wait":
            driver.sleep_until_ns(begin_ns + ns)
        else:
            host.compute(ns)
        assert before_ns <= driver.now_ns() <= host.now_ns()
        assert host.now_ns() - driver.now_ns() <= LAG_MAX_NS
        before_ns = driver.now_ns()


class Laggard:
    """A host that computes for a while before each wait, and then wakes late."""

    def __init__(self, host: Host, compute_ns: int, late_ns: int) -> None:
        self._host = host
        self._compute_ns, self._late_ns = compute_ns, late_ns

    def now_ns(self) -> int:
        return self._host.now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        self._host.compute(self._compute_ns)
        if t_ns > self._host.now_ns():
            self._host.sleep_until_ns(t_ns + self._late_ns)


def instants(clock: Clock, world: World, frames: int = 200) -> list[list[int]]:
    """Return the instants of conversions by a driver with this clock, since the first."""
    ready = prepare_array(open_bus("emulated", world.i2c_adapter), world.scene, clock)
    begin_ns = clock.now_ns()
    scans = [ready.array.scan_frame() for _ in range(frames)]
    assert all(scan.tile_flags == [0] * 4 for scan in scans)
    return [[t_ns - begin_ns for t_ns in scan.convert_stop_ns] for scan in scans]


@pytest.mark.parametrize(("compute_us", "late_us"), [(0, 60), (40, 0), (90, 60)])
def test_a_driver_on_a_slow_machine_has_the_instants_of_virtual_time(
    compute_us: int, late_us: int
) -> None:
    scene = load_scene("standing")
    clock = VirtualClock(1_000_000_000)
    expected = instants(clock, World(scene, clock))
    host = Host()
    driver = DriverClock(host)
    wires = WireClock(driver, Laggard(host, compute_us * 1000, late_us * 1000))
    assert instants(driver, World(scene, wires, in_real_time=True)) == expected
