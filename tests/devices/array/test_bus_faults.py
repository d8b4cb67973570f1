"""A bus that fails: told from a silent tile, reopened, in warnings; the bus monitor by itself."""

from __future__ import annotations

from itertools import pairwise

import pytest

from devices.array.bus_recovery import BusMonitor
from devices.array.tile import Scan
from devices.array.tile_array import TileArray
from devices.buses.device_files import DeviceReopener
from devices.buses.i2c import I2cBus
from devices.chips.tca9548a import MuxRouter
from devices.errors import BusMisuseError, BusSetupError
from devices.flags import TileFlag
from devices.frames import NOT_READ
from devices.scene.emulation_sections import FaultKind
from devices.scene.hardware_sections import ScheduleName
from tests.devices.rigs import (
    FOUR,
    ONE,
    SETTLED,
    TWO_MUXES,
    Plugs,
    ScriptedRecovery,
    Wires,
    array_on,
    every_schedule,
    failing,
    scanned,
    settled,
    settled_on,
)


def assert_fault_of_the_bus(scan: Scan) -> None:
    assert scan.bus_fault
    assert scan.pressure_raw == [NOT_READ] * 4
    assert all(flags & TileFlag.NO_ANSWER for flags in scan.tile_flags)


def assert_healthy(array: TileArray, scan: Scan) -> None:
    assert not scan.bus_fault
    assert scan.tile_flags == [0] * len(array.tiles)
    assert array.get_warnings() == {}


@pytest.mark.parametrize("number", [5, 110, 11, 16])
@every_schedule
def test_a_fault_of_the_bus_is_no_silent_tile(schedule: ScheduleName, number: int) -> None:
    wires, array = settled_on(FOUR, schedule)
    wires.on_transaction = failing(number)
    for _ in range(3):
        assert_fault_of_the_bus(array.scan_frame())
    assert "stuck" in array.get_warnings()[""]
    wires.on_transaction = lambda _, __: None
    assert_healthy(array, scanned(array, 3))


def test_a_stuck_bus_is_tried_once_a_frame() -> None:
    # Each transfer may cost the adapter's 30 ms.
    wires, array = settled_on(FOUR)
    wires.on_transaction = failing(110)
    for transfers in (2, 1, 1, 1):  # hardware.md 8: stop after two timeouts
        wires.log.clear()
        array.scan_frame()
        assert len(wires.log) == transfers


def test_a_fault_of_the_bus_is_flagged_although_the_second_attempt_succeeded() -> None:
    wires, array = settled_on(FOUR)
    last = array.scan_frame().pressure_raw
    wires.log.clear()
    wires.on_transaction = failing(11, lambda count, _: count == 4)  # the first tile's read
    scan = array.scan_frame()
    assert scan.bus_fault
    assert scan.tile_flags == [TileFlag.RETRIED, 0, 0, 0]
    assert scan.pressure_raw == [pressure_raw + 1 for pressure_raw in last]


@pytest.mark.parametrize("number", [22, 95])
@every_schedule
def test_a_transfer_that_no_adapter_supports_is_raised(schedule: ScheduleName, number: int) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, schedule)
    array.scan_frame()
    wires.on_transaction = failing(number, lambda _, messages: bool(messages[0].addr == 0x60))
    with pytest.raises(BusMisuseError):
        array.scan_frame()


@every_schedule
def test_an_adapter_that_is_lost_at_any_transfer_is_a_fault_of_the_bus(
    schedule: ScheduleName,
) -> None:
    for after in range(60):
        wires, array = settled_on(FOUR, schedule)
        with wires.fault("no_answer", "T02"):  # one tile is looked for, too
            array.scan_frame()
        wires.log.clear()
        # mypy infers no type of a lambda with a default.
        wires.on_transaction = failing(19, lambda count, _, after=after: count > after)  # type: ignore[misc]
        assert_fault_of_the_bus(scanned(array, 10))
        wires.on_transaction = lambda _, __: None
        assert_healthy(array, scanned(array, 10))


@every_schedule
@pytest.mark.parametrize("plugs", [ONE, TWO_MUXES])
@pytest.mark.parametrize(
    ("kind", "flag"),
    # hardware.md 8: 0/0 on several tiles, 50.00 kPa with all-zero coefficients
    [("sda_high", TileFlag.NO_ANSWER), ("sda_low", TileFlag.UNUSABLE)],
)
def test_a_stuck_bus_is_flagged_from_the_first_frame_on(
    schedule: ScheduleName, kind: FaultKind, flag: TileFlag, plugs: Plugs
) -> None:
    wires, array = settled_on(plugs, schedule)
    with wires.fault(kind):
        for _ in range(10):
            scan = array.scan_frame()
            assert scan.bus_fault
            assert all(flags & flag for flags in scan.tile_flags)
    assert_healthy(array, scanned(array, SETTLED + 2))


# An adapter that is reopened


class ReopenedWires(Wires):
    """Wires with an adapter that is opened by its path, as one on USB."""

    def __init__(self, plugs: Plugs, *, is_present: bool = True) -> None:
        super().__init__(plugs)
        self.is_present = is_present
        self.opened_ns: list[int] = []
        self.closed = 0

    @property
    def bus(self) -> I2cBus:
        return I2cBus(self, "/dev/i2c-3", DeviceReopener(self.open, is_synchronous=True))

    def open(self) -> ReopenedWires:
        self.opened_ns.append(self.clock.now_ns())
        if not self.is_present:
            raise BusSetupError("the bus cannot be used (ENOENT)", where="/dev/i2c-3", errno=2)
        return self

    def close(self) -> None:
        self.closed += 1


def test_a_missing_adapter_is_opened_once_a_second_while_frames_go_on() -> None:
    wires = ReopenedWires(FOUR, is_present=False)
    array = settled(wires)
    wires.on_transaction = failing(19)
    begin_ns = wires.clock.now_ns()
    frames = 0
    while wires.clock.now_ns() < begin_ns + 3_500_000_000:
        assert_fault_of_the_bus(array.scan_frame())
        frames += 1
    assert wires.closed == 1
    assert len(wires.opened_ns) == 4
    assert min(b - a for a, b in pairwise(wires.opened_ns)) >= 1_000_000_000
    assert frames > 3.5 * 300, "at the usual rate"
    assert "missing" in array.get_warnings()[""]
    assert "ENOENT" in array.get_warnings()[""]
    wires.is_present, wires.on_transaction = True, lambda _, __: None
    end_ns = wires.clock.now_ns() + 1_100_000_000
    while wires.clock.now_ns() < end_ns:
        scan = array.scan_frame()
    assert_healthy(array, scan)


def test_an_open_file_that_keeps_failing_is_opened_again() -> None:
    # i2c-tiny-usb that was plugged in again: every transfer through the old file is EIO.
    wires = ReopenedWires(FOUR)
    array = settled(wires)
    wires.on_transaction = failing(5, lambda _, __: not wires.opened_ns)
    end_ns = wires.clock.now_ns() + 1_500_000_000
    while wires.clock.now_ns() < end_ns:
        scan = array.scan_frame()
    assert (wires.closed, len(wires.opened_ns)) == (1, 1)
    assert_healthy(array, scan)


@pytest.mark.parametrize("has_recovery", [False, True])
def test_a_warning_names_a_stuck_bus_and_the_failure_of_its_recovery(has_recovery: bool) -> None:
    wires = Wires(FOUR)
    busy = ScriptedRecovery(wires.adapter, wires.clock, fails=True, has_reset=False)
    array = array_on(wires, recovery=busy if has_recovery else None)
    with wires.fault("sda_low"):
        scanned(array, 3)
        assert list(array.get_warnings()) == [""]
        text = array.get_warnings()[""]
    assert text.startswith("the bus is stuck or cut")
    assert ("gpio: another program has the lines" in text) == has_recovery
    assert_healthy(array, scanned(array, 200))


# The monitor: a mux that keeps its mask shows that the bus works

MS = 1_000_000


def monitored(
    *, has_recovery: bool = True, **script: bool
) -> tuple[Wires, ScriptedRecovery, BusMonitor]:
    wires = Wires(TWO_MUXES)
    recovery = ScriptedRecovery(wires.adapter, wires.clock, **script)
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


@pytest.mark.parametrize(
    ("script", "resets"),
    [
        ({"clocks_free": True}, 0),
        ({"reset_frees": True}, 1),
        ({"reset_frees": True, "reports_free": False}, 1),
        ({"reset_frees": True, "fails": True}, 1),
    ],
)
def test_a_bus_is_reset_only_if_clocks_do_not_free_it(script: dict[str, bool], resets: int) -> None:
    wires, recovery, monitor = monitored(**script)
    with wires.fault("sda_low"):
        monitor.mark_down()
        assert monitor.try_reconnect()
    assert (len(recovery.asked_ns), recovery.resets) == (1, resets)


def test_a_failed_recovery_is_a_problem_until_the_bus_works_again() -> None:
    wires, _, monitor = monitored(fails=True, has_reset=False)
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
