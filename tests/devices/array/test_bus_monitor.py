"""Does the bus move at all? Told by a mux that keeps, or does not keep, what is written to it."""

from __future__ import annotations

import pytest

from devices.array.bus_monitor import BusMonitor
from devices.array.tile import Scan
from devices.chips.tca9548a import MuxRouter
from devices.errors import BusSetupError
from tests.devices.rigs import TWO_MUXES, Wires

MS = 1_000_000


class Helper:
    """A recovery that notes when it is asked, may fail itself, and may free SDA."""

    def __init__(self, wires: Wires) -> None:
        self.wires = wires
        self.asked_ns: list[int] = []
        self.resets = 0
        self.fails = False
        self.lets_go = True
        self.clocks_free = False
        self.reset_frees = False
        self.reset_is_wired = True

    def send_recovery_clocks(self) -> bool:
        self.asked_ns.append(self.wires.clock.now_ns())
        if self.fails:
            raise BusSetupError("the lines are somebody else's", where="gpio", errno=16)
        if self.clocks_free:
            self.free()
        return self.lets_go

    def reset_muxes(self) -> bool:
        self.resets += 1
        if self.reset_frees:
            self.free()
        return self.reset_is_wired

    def free(self) -> None:
        self.wires.adapter.line.sda_low.end_at(self.wires.clock.now_ns())


def watch_on(wires: Wires, helper: Helper | None = None) -> BusMonitor:
    return BusMonitor(MuxRouter(wires.bus, (mux for mux, _ in TWO_MUXES)), wires.clock, helper)


def helped() -> tuple[Wires, Helper, BusMonitor]:
    """A bus, what can help it, and who watches it."""
    wires = Wires(TWO_MUXES)
    helper = Helper(wires)
    return wires, helper, watch_on(wires, helper)


def scan_on(wires: Wires) -> Scan:
    return Scan.empty(4, wires.clock.now_ns(), 0)


def test_a_bus_that_moves_is_no_reason_to_give_a_frame_up() -> None:
    wires = Wires(TWO_MUXES)
    watch_on(wires).check_bus(scan := scan_on(wires))
    assert not scan.bus_fault
    assert not scan.is_abandoned


def test_one_mux_that_answers_is_enough() -> None:
    wires = Wires(TWO_MUXES)
    with wires.fault("brown_out", "0x70"):
        watch_on(wires).check_bus(scan := scan_on(wires))
    assert not scan.bus_fault


def test_a_bus_that_does_not_move_gives_the_frame_up_at_once() -> None:
    wires = Wires(TWO_MUXES)
    for kind in ("sda_low", "sda_high", "scl_low"):
        with wires.fault(kind):
            watch_on(wires).check_bus(scan := scan_on(wires))
        assert scan.bus_fault
        assert scan.is_abandoned


def test_a_bus_that_fell_is_down_until_it_moves_again() -> None:
    wires = Wires(TWO_MUXES)
    watch = watch_on(wires)
    assert not watch.is_down
    with wires.fault("sda_high"):
        watch.mark_down()
        assert watch.is_down
        assert not watch.try_reconnect()
        assert watch.is_down
    assert watch.try_reconnect()
    assert not watch.is_down
    assert watch.recovery_attempts == 0, "there was nobody to help"


def test_a_stuck_bus_is_helped_at_once_and_then_ever_more_rarely() -> None:
    wires, helper, watch = helped()
    with wires.fault("sda_low"):
        watch.mark_down()
        begin_ns = wires.clock.now_ns()
        while wires.clock.now_ns() < begin_ns + 5_000 * MS:
            assert not watch.try_reconnect()
            wires.clock.sleep_until_ns(wires.clock.now_ns() + MS)
    waits_ms = [
        round((after - before) / MS)
        for before, after in zip(helper.asked_ns, helper.asked_ns[1:], strict=False)
    ]
    assert helper.asked_ns[0] - begin_ns < MS
    assert all(
        abs(found - due) <= 3
        for found, due in zip(waits_ms, [10, 20, 40, 80, 160, 320, 640, 1000, 1000], strict=False)
    )
    assert len(waits_ms) >= 9
    assert watch.recovery_attempts == len(helper.asked_ns)
    assert helper.resets == len(helper.asked_ns), "neither of them was enough"


def test_clocks_that_free_the_bus_are_all_that_is_done() -> None:
    wires, helper, watch = helped()
    helper.clocks_free = True
    with wires.fault("sda_low"):
        watch.mark_down()
        assert watch.try_reconnect()
    assert (len(helper.asked_ns), helper.resets) == (1, 0)


@pytest.mark.parametrize("lets_go", [False, True])
@pytest.mark.parametrize("fails", [False, True])
def test_reset_is_for_a_bus_that_does_not_move_after_nine_clocks(
    fails: bool, lets_go: bool
) -> None:
    wires = Wires(TWO_MUXES)
    helper = Helper(wires)
    helper.fails, helper.lets_go, helper.reset_frees = fails, lets_go, True
    watch = watch_on(wires, helper)
    with wires.fault("sda_low"):
        watch.mark_down()
        assert watch.try_reconnect()
    assert len(helper.asked_ns) == helper.resets == 1


def test_what_kept_the_bus_from_being_helped_is_told_until_it_is_back() -> None:
    wires = Wires(TWO_MUXES)
    helper = Helper(wires)
    helper.fails, helper.reset_is_wired = True, False
    watch = watch_on(wires, helper)
    with wires.fault("sda_low"):
        watch.mark_down()
        assert watch.problem == ""
        assert not watch.try_reconnect()
        assert watch.problem == "gpio: the lines are somebody else's"
    watch.mark_down()
    assert watch.try_reconnect()
    assert watch.problem == ""


def test_after_it_was_well_a_stuck_bus_is_helped_at_once_again() -> None:
    wires, helper, watch = helped()
    for _ in range(3):
        with wires.fault("sda_low"):
            watch.mark_down()
            asked = len(helper.asked_ns)
            assert not watch.try_reconnect()
            assert len(helper.asked_ns) == asked + 1
        assert watch.try_reconnect()


def test_a_line_that_cannot_be_had_now_does_not_end_the_stream() -> None:
    wires, helper, watch = helped()
    helper.fails = True
    with wires.fault("sda_low"):
        watch.mark_down()
        assert not watch.try_reconnect()
    assert helper.asked_ns
    assert watch.try_reconnect()


def test_a_bus_that_moves_needs_no_help() -> None:
    _, helper, watch = helped()
    watch.mark_down()
    assert watch.try_reconnect()
    assert helper.asked_ns == []
