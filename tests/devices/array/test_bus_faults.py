"""A bus that fails, as an array sees it: told from a silent tile, and said in words."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import pytest
from smbus2 import i2c_msg

from devices.buses.device_files import DeviceReopener
from devices.buses.i2c import I2cBus
from devices.errors import BusMisuseError, BusSetupError
from devices.flags import TileFlag
from devices.frames import NOT_READ
from devices.scene.emulation_sections import FaultKind
from devices.scene.hardware_sections import ScheduleName
from tests.devices.array.wiring import every_schedule, failing, to_tiles
from tests.devices.rigs import (
    FOUR,
    ONE,
    SETTLED,
    TWO_MUXES,
    Plugs,
    Wires,
    array_on,
    scanned,
    settled,
    settled_on,
)


@pytest.mark.parametrize("number", [5, 110, 11, 16])
@every_schedule
def test_a_fault_of_the_bus_is_told_from_a_silent_tile(schedule: ScheduleName, number: int) -> None:
    wires, array = settled_on(FOUR, schedule)
    wires.on_transaction = failing(number, lambda _, __: True)
    for _ in range(3):
        scan = array.scan_frame()
        assert scan.bus_fault
        assert scan.pressure_raw == [NOT_READ] * 4
        assert all(status & TileFlag.NO_ANSWER for status in scan.tile_flags)
    assert "stuck" in array.get_warnings()[""]
    wires.on_transaction = lambda _, __: None
    scan = scanned(array, 3)
    assert not scan.bus_fault
    assert scan.tile_flags == [0] * 4
    assert array.get_warnings() == {}


def test_a_stuck_bus_is_asked_for_once_a_frame_and_no_more() -> None:
    # Each transfer may cost the adapter's 30 ms.
    wires, array = settled_on(FOUR)
    wires.on_transaction = failing(110, lambda _, __: True)
    wires.log.clear()
    array.scan_frame()
    assert len(wires.log) == 2, "after two time-outs stop (hardware.md 8)"
    for _ in range(5):
        wires.log.clear()
        array.scan_frame()
        assert len(wires.log) == 1


def test_a_fault_of_the_bus_shows_although_the_second_attempt_succeeded() -> None:
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
def test_a_bug_of_ours_is_raised_and_not_flagged(schedule: ScheduleName, number: int) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, schedule)
    array.scan_frame()
    wires.on_transaction = failing(number, to_tiles)
    with pytest.raises(BusMisuseError):
        array.scan_frame()


@every_schedule
def test_an_adapter_that_goes_away_is_a_flag_wherever_it_is_noticed(schedule: ScheduleName) -> None:
    for after in range(60):
        wires, array = settled_on(FOUR, schedule)
        with wires.fault("no_answer", "T02"):  # one tile is looked for, too
            array.scan_frame()
        wires.log.clear()
        wires.on_transaction = failing(19, partial(later_than, after))
        for _ in range(20):
            scan = array.scan_frame()
        assert scan.bus_fault
        assert scan.pressure_raw == [NOT_READ] * 4
        assert all(status & TileFlag.NO_ANSWER for status in scan.tile_flags)
        wires.on_transaction = lambda _, __: None
        assert scanned(array, 10).tile_flags == [0] * 4
        assert array.get_warnings() == {}


class ReopenedWires(Wires):
    """Wires whose adapter is opened by its path, as a USB adapter's is."""

    def __init__(self, plugs: Plugs, *, opens: bool = True) -> None:
        super().__init__(plugs)
        self.opens = opens
        self.opened_ns: list[int] = []
        self.closed = 0

    @property
    def bus(self) -> I2cBus:
        return I2cBus(self, "/dev/i2c-3", DeviceReopener(self.open, is_synchronous=True))

    def open(self) -> ReopenedWires:
        self.opened_ns.append(self.clock.now_ns())
        if not self.opens:
            raise BusSetupError("the bus cannot be used (ENOENT)", where="/dev/i2c-3", errno=2)
        return self

    def close(self) -> None:
        self.closed += 1


def test_an_adapter_that_is_away_is_opened_once_a_second_while_frames_go_on() -> None:
    wires = ReopenedWires(FOUR, opens=False)
    array = settled(wires)
    wires.on_transaction = failing(19, lambda _, __: True)
    begin_ns = wires.clock.now_ns()
    frames = 0
    while wires.clock.now_ns() < begin_ns + 3_500_000_000:
        scan = array.scan_frame()
        frames += 1
        assert scan.bus_fault
        assert scan.pressure_raw == [NOT_READ] * 4
    assert wires.closed == 1
    assert len(wires.opened_ns) == 4
    assert min(b - a for a, b in pairwise(wires.opened_ns)) >= 1_000_000_000
    assert frames > 3.5 * 300, "the rate of frames is kept"
    assert "missing" in array.get_warnings()[""]
    assert "ENOENT" in array.get_warnings()[""]
    wires.opens, wires.on_transaction = True, lambda _, __: None
    end_ns = wires.clock.now_ns() + 1_100_000_000
    while wires.clock.now_ns() < end_ns:
        scan = array.scan_frame()
    assert not scan.bus_fault
    assert scan.tile_flags == [0] * 4
    assert array.get_warnings() == {}


def test_an_open_file_that_fails_for_good_is_opened_anew() -> None:
    # i2c-tiny-usb that was plugged in again: every transfer through the old file is EIO.
    wires = ReopenedWires(FOUR)
    array = settled(wires)
    wires.on_transaction = failing(5, lambda _, __: not wires.opened_ns)
    end_ns = wires.clock.now_ns() + 1_500_000_000
    while wires.clock.now_ns() < end_ns:
        scan = array.scan_frame()
    assert (wires.closed, len(wires.opened_ns)) == (1, 1)
    assert scan.tile_flags == [0] * 4


@every_schedule
@pytest.mark.parametrize("plugs", [ONE, FOUR, TWO_MUXES])
@pytest.mark.parametrize(
    ("kind", "flag"),
    [
        ("sda_high", TileFlag.NO_ANSWER),
        # hardware.md 8: 0/0 on several tiles, 50.00 kPa with all-zero coefficients
        ("sda_low", TileFlag.UNUSABLE),
    ],
)
def test_a_bus_that_answers_nothing_or_everything_is_a_fault_of_the_bus_from_the_first_frame_on(
    schedule: ScheduleName, plugs: Plugs, kind: FaultKind, flag: TileFlag
) -> None:
    wires, array = settled_on(plugs, schedule)
    with wires.fault(kind):
        for _ in range(10):
            scan = array.scan_frame()
            assert scan.bus_fault
            assert all(status & flag for status in scan.tile_flags)
    scan = scanned(array, SETTLED + 2)
    assert scan.tile_flags == [0] * len(plugs)
    assert not scan.bus_fault


@every_schedule
@pytest.mark.parametrize("broken", [0x70, 0x73])
def test_the_tiles_of_the_other_mux_go_on_while_one_is_without_supply(
    schedule: ScheduleName, broken: int
) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    others = array.tiles_by_mux[1 if broken == 0x70 else 0]
    with wires.fault("brown_out", f"0x{broken:02x}"):
        scans = [array.scan_frame() for _ in range(100)]
    for scan in scans:
        for i in range(4):
            if i not in others:
                assert scan.tile_flags[i] & TileFlag.NO_ANSWER
                assert scan.pressure_raw[i] == NOT_READ
    for before, after in pairwise(scans[5:]):
        for i in others:
            assert after.tile_flags[i] == 0
            assert after.pressure_raw[i] == before.pressure_raw[i] + 1
    scan = scanned(array, 200)
    assert scan.tile_flags == [0] * 4


def later_than(after: int, count: int, _: tuple[i2c_msg, ...]) -> bool:
    return count > after


# What is wrong, in words


class NoLines:
    """A recovery whose lines are somebody else's."""

    def send_recovery_clocks(self) -> bool:
        raise BusSetupError("GPIO lines cannot be used (EBUSY)", where="/dev/gpiochip0, lines 2, 3")

    def reset_muxes(self) -> bool:
        return False


def test_a_stuck_bus_is_said_and_what_kept_it_from_being_helped() -> None:
    wires = Wires(FOUR)
    plain, helped = array_on(wires), array_on(wires, recovery=NoLines())
    for array in (plain, helped):
        with wires.fault("sda_low"):
            scanned(array, 3)
            assert list(array.get_warnings()) == [""]
            text = array.get_warnings()[""]
        scanned(array, 200)
        assert array.get_warnings() == {}
        assert text.startswith("the bus is stuck or cut")
        assert ("GPIO lines cannot be used" in text) == (array is helped)
