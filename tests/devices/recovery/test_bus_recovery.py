"""Freeing a stuck bus: what the wires do, for chips that hold them in every way."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import VirtualClock
from devices.recovery import (
    RECOVERY_CLOCKS,
    GpioRecovery,
    OpenDrainLine,
    open_gpio_recovery,
)

FOREVER = 10**9


class Chip:
    """Holds SDA for so many clocks. A STOP that it hears ends that."""

    def __init__(self, holds: int = 0) -> None:
        self.holds = holds

    @property
    def sda_low(self) -> bool:
        return self.holds > 0

    def scl_fell(self) -> None:
        self.holds -= 1

    def scl_rose(self, sda_high: bool) -> None:
        pass

    def stopped(self) -> None:
        self.holds = 0


class Sender(Chip):
    """Was broken off while sending bytes, at some bit of the first one.

    It puts out a bit at each falling edge and lets go for the acknowledge. If it gets one, the next
    byte follows; if not, it has done.
    """

    def __init__(self, data: list[int], bit: int) -> None:
        super().__init__()
        self._data = data
        self._at = bit
        self.sending = True

    @property
    def sda_low(self) -> bool:
        if not self.sending or self._at % 9 == 8:
            return False
        # Behind its last byte a chip that is asked for more sends zeros, the worst it could.
        byte = dict(enumerate(self._data)).get(self._at // 9, 0)
        return not byte >> (7 - self._at % 9) & 1

    def scl_fell(self) -> None:
        self._at += 1

    def scl_rose(self, sda_high: bool) -> None:
        if self._at % 9 == 8 and sda_high:
            self.sending = False

    def stopped(self) -> None:
        self.sending = False


class Wire:
    """One open-drain wire; tells the bus when we move it."""

    def __init__(self, bus: Bus) -> None:
        self.ours_low = False
        self._bus = bus

    def drive(self, *, low: bool) -> None:
        self._bus.move(self, low)

    def is_high(self) -> bool:
        assert self._bus.taken, "a line was read that is not ours"
        return self._bus.level(self)


class Bus:
    """Two wires with a chip on them, and RESET; notes every edge that we make."""

    def __init__(self, chip: Chip, *, scl_held: bool = False, reset_wired: bool = True) -> None:
        self.clock = VirtualClock()
        self.edges: list[tuple[int, str, bool]] = []
        self.stops = 0
        self.taken = False
        self.resets: list[tuple[int, bool]] = []
        self._chip = chip
        self._scl_held = scl_held
        self._reset_wired = reset_wired
        self.scl, self.sda = Wire(self), Wire(self)

    def level(self, wire: Wire) -> bool:
        held = self._scl_held if wire is self.scl else self._chip.sda_low
        return not (wire.ours_low or held)

    def move(self, wire: Wire, low: bool) -> None:
        assert self.taken, "a line was moved that is not ours"
        before = self.level(self.scl), self.level(self.sda)
        wire.ours_low = low
        self.edges.append((self.clock.now_ns(), "scl" if wire is self.scl else "sda", low))
        after = self.level(self.scl), self.level(self.sda)
        if before[0] and not after[0]:
            self._chip.scl_fell()
        elif after[0] and not before[0]:
            self._chip.scl_rose(after[1])
        elif after == (True, True) and before == (True, False):
            self.stops += 1
            self._chip.stopped()

    @property
    def clocks(self) -> int:
        return sum(name == "scl" and low for _, name, low in self.edges)

    @contextmanager
    def request_scl_sda(self) -> Iterator[tuple[OpenDrainLine, OpenDrainLine]]:
        self.taken = True
        yield self.scl, self.sda
        assert not self.scl.ours_low
        assert not self.sda.ours_low
        self.taken = False

    def request_reset(self) -> AbstractContextManager[OpenDrainLine] | None:
        return self._reset_line() if self._reset_wired else None

    @contextmanager
    def _reset_line(self) -> Iterator[OpenDrainLine]:
        yield ResetLine(self)


class ResetLine:
    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def drive(self, *, low: bool) -> None:
        self._bus.resets.append((self._bus.clock.now_ns(), low))

    def is_high(self) -> bool:
        raise AssertionError("nobody needs to know")


def recovery(bus: Bus) -> GpioRecovery:
    return GpioRecovery(bus, bus.clock)


@pytest.mark.parametrize("holds", range(RECOVERY_CLOCKS + 1))
def test_whoever_holds_sda_for_up_to_nine_clocks_is_clocked_out(holds: int) -> None:
    bus = Bus(Chip(holds))
    # UM10204 3.1.16: nine clocks; and no more of them than needed, the STOP's own among them
    assert recovery(bus).send_recovery_clocks()
    assert bus.clocks == holds + 1
    assert bus.stops == 1
    assert not bus.taken


def test_sda_that_is_held_for_ever_is_given_up_after_nine_clocks() -> None:
    bus = Bus(Chip(FOREVER))
    assert not recovery(bus).send_recovery_clocks()
    assert bus.clocks == RECOVERY_CLOCKS
    assert bus.stops == 0
    assert bus.clock.now_ns() < 1_000_000
    assert not bus.taken


def test_scl_that_is_held_low_is_given_up_at_once() -> None:
    bus = Bus(Chip(), scl_held=True)
    assert not recovery(bus).send_recovery_clocks()
    assert bus.edges == []
    assert bus.clock.now_ns() < 100_000
    assert not bus.taken


def test_a_bus_that_is_free_gets_a_stop_and_no_more() -> None:
    bus = Bus(Chip())
    assert recovery(bus).send_recovery_clocks()
    assert [(name, low) for _, name, low in bus.edges] == [
        ("scl", True),
        ("sda", True),
        ("scl", False),
        ("sda", False),
    ]


def test_sda_stays_with_the_chip_while_it_is_clocked() -> None:
    bus = Bus(Chip(5))
    recovery(bus).send_recovery_clocks()
    assert [name for _, name, _ in bus.edges[:10]] == ["scl"] * 10


@given(
    data=st.lists(st.integers(0, 255), min_size=1, max_size=4),
    bit=st.integers(0, 8),
)
def test_a_chip_broken_off_in_any_bit_of_any_byte_is_freed(data: list[int], bit: int) -> None:
    chip = Sender(data, bit)
    bus = Bus(chip)
    assert recovery(bus).send_recovery_clocks()
    assert not chip.sending
    assert bus.clocks <= RECOVERY_CLOCKS + 1


@pytest.mark.parametrize("holds", [0, 3, FOREVER])
def test_no_two_edges_are_nearer_than_half_a_period_of_100_khz(holds: int) -> None:
    bus = Bus(Chip(holds))
    recovery(bus).send_recovery_clocks()
    times_ns = [t_ns for t_ns, _, _ in bus.edges]
    assert times_ns[0] >= 5_000
    assert all(b - a >= 5_000 for a, b in pairwise(times_ns))


def test_the_muxes_reset_is_low_for_ten_microseconds_and_then_let_go() -> None:
    bus = Bus(Chip())
    assert recovery(bus).reset_muxes()
    (begin_ns, pulled), (end_ns, still_pulled) = bus.resets
    assert (pulled, still_pulled) == (True, False)
    assert end_ns - begin_ns == 10_000
    assert bus.edges == []


def test_a_reset_that_is_not_wired_is_said() -> None:
    bus = Bus(Chip(), reset_wired=False)
    assert not recovery(bus).reset_muxes()
    assert bus.clock.now_ns() == 0


def test_a_scene_without_recovery_has_none() -> None:
    assert open_gpio_recovery(None, VirtualClock()) is None
