"""The monitor of a bus: a mux that keeps its mask shows that the bus works."""

from __future__ import annotations

from itertools import pairwise

import pytest

from devices.array.bus_monitor import BusMonitor
from devices.array.tile import Scan
from devices.chips.tca9548a import MuxRouter
from devices.errors import BusSetupError
from tests.devices.rigs import TWO_MUXES, Wires

MS = 1_000_000


class Recovery:
    """A recovery that records its calls, may fail, and may free SDA."""

    def __init__(self, wires: Wires) -> None:
        self.wires = wires
        self.asked_ns: list[int] = []
        self.resets = 0
        self.fails = False
        self.reports_free = True
        self.clocks_free = False
        self.reset_frees = False
        self.has_reset = True

    def send_recovery_clocks(self) -> bool:
        self.asked_ns.append(self.wires.clock.now_ns())
        if self.fails:
            raise BusSetupError("another program has the lines", where="gpio", errno=16)
        if self.clocks_free:
            self.wires.adapter.line.sda_low.end_at(self.wires.clock.now_ns())
        return self.reports_free

    def reset_muxes(self) -> bool:
        self.resets += 1
        if self.reset_frees:
            self.wires.adapter.line.sda_low.end_at(self.wires.clock.now_ns())
        return self.has_reset


def monitored(*, has_recovery: bool = True) -> tuple[Wires, Recovery, BusMonitor]:
    wires = Wires(TWO_MUXES)
    recovery = Recovery(wires)
    router = MuxRouter(wires.bus, (mux for mux, _ in TWO_MUXES))
    return wires, recovery, BusMonitor(router, wires.clock, recovery if has_recovery else None)


def test_a_frame_is_abandoned_only_if_no_mux_works() -> None:
    wires, _, monitor = monitored()
    monitor.check_bus(healthy := Scan.empty(4, 0, 0))
    with wires.fault("brown_out", "0x70"):
        monitor.check_bus(with_one_mux := Scan.empty(4, 0, 0))
    for scan in (healthy, with_one_mux):
        assert not scan.bus_fault
        assert not scan.is_abandoned
    for kind in ("sda_low", "sda_high", "scl_low"):
        with wires.fault(kind):
            monitor.check_bus(scan := Scan.empty(4, 0, 0))
        assert scan.bus_fault
        assert scan.is_abandoned


def test_a_bus_is_down_until_it_works_again() -> None:
    wires, _, monitor = monitored(has_recovery=False)
    assert not monitor.is_down
    with wires.fault("sda_high"):
        monitor.mark_down()
        assert monitor.is_down
        assert not monitor.try_reconnect()
        assert monitor.is_down
    assert monitor.try_reconnect()
    assert not monitor.is_down
    assert monitor.recovery_attempts == 0


def test_a_stuck_bus_is_recovered_at_once_and_then_ever_more_rarely() -> None:
    wires, recovery, monitor = monitored()
    with wires.fault("sda_low"):
        monitor.mark_down()
        begin_ns = wires.clock.now_ns()
        while wires.clock.now_ns() < begin_ns + 5_000 * MS:
            assert not monitor.try_reconnect()
            wires.clock.sleep_until_ns(wires.clock.now_ns() + MS)
    assert recovery.asked_ns[0] - begin_ns < MS
    waits_ms = [(after - before) / MS for before, after in pairwise(recovery.asked_ns)]
    assert waits_ms[:9] == pytest.approx([10, 20, 40, 80, 160, 320, 640, 1000, 1000], abs=3)
    assert monitor.recovery_attempts == len(recovery.asked_ns)
    assert recovery.resets == len(recovery.asked_ns), "clocks were not enough"


def test_a_bus_that_clocks_free_is_not_reset() -> None:
    wires, recovery, monitor = monitored()
    recovery.clocks_free = True
    with wires.fault("sda_low"):
        monitor.mark_down()
        assert monitor.try_reconnect()
    assert (len(recovery.asked_ns), recovery.resets) == (1, 0)


@pytest.mark.parametrize("reports_free", [False, True])
@pytest.mark.parametrize("fails", [False, True])
def test_a_bus_that_clocks_do_not_free_is_reset(fails: bool, reports_free: bool) -> None:
    wires, recovery, monitor = monitored()
    recovery.fails, recovery.reports_free, recovery.reset_frees = fails, reports_free, True
    with wires.fault("sda_low"):
        monitor.mark_down()
        assert monitor.try_reconnect()
    assert len(recovery.asked_ns) == recovery.resets == 1


def test_a_failed_recovery_is_a_problem_until_the_bus_works_again() -> None:
    wires, recovery, monitor = monitored()
    recovery.fails, recovery.has_reset = True, False
    with wires.fault("sda_low"):
        monitor.mark_down()
        assert monitor.problem == ""
        assert not monitor.try_reconnect()
        assert monitor.problem == "gpio: another program has the lines"
    monitor.mark_down()
    assert monitor.try_reconnect()
    assert monitor.problem == ""


def test_a_bus_that_is_stuck_again_is_recovered_at_once() -> None:
    wires, recovery, monitor = monitored()
    for attempts in (1, 2, 3):
        with wires.fault("sda_low"):
            monitor.mark_down()
            assert not monitor.try_reconnect()
            assert len(recovery.asked_ns) == attempts
        assert monitor.try_reconnect()
    monitor.mark_down()
    assert monitor.try_reconnect()
    assert len(recovery.asked_ns) == 3, "a bus that works needs none"
