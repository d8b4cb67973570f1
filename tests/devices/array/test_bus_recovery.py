"""Recovery of a stuck bus: the edges on its wires, for chips that hold them in every way."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.array.bus_recovery import (
    RECOVERY_CLOCKS,
    GpioRecovery,
    OpenDrainLine,
    open_gpio_recovery,
)
from devices.clock import VirtualClock

FOREVER = 10**9


class Chip:
    """A chip that holds SDA low for so many clocks, or until a STOP."""

    def __init__(self, clocks: int = 0) -> None:
        self.clocks = clocks

    @property
    def sda_low(self) -> bool:
        return self.clocks > 0

    def scl_fell(self) -> None:
        self.clocks -= 1

    def scl_rose(self, sda_high: bool) -> None:
        pass

    def stopped(self) -> None:
        self.clocks = 0


class Sender(Chip):
    """A chip that was interrupted while it sent bytes, at some bit of the first one.

    It sends a bit at each falling edge and releases SDA for the acknowledge. After an acknowledge
    it sends the next byte; without one it stops.
    """

    def __init__(self, data: list[int], bit: int) -> None:
        super().__init__()
        self._data = data
        self._at = bit
        self.is_sending = True

    @property
    def sda_low(self) -> bool:
        if not self.is_sending or self._at % 9 == 8:
            return False
        # After its last byte a chip sends zeros, the worst case.
        byte = dict(enumerate(self._data)).get(self._at // 9, 0)
        return not byte >> (7 - self._at % 9) & 1

    def scl_fell(self) -> None:
        self._at += 1

    def scl_rose(self, sda_high: bool) -> None:
        if self._at % 9 == 8 and sda_high:
            self.is_sending = False

    def stopped(self) -> None:
        self.is_sending = False


class Wire:
    """One open-drain line. RESET is one without a level."""

    def __init__(self, bus: Bus, name: str) -> None:
        self.is_low = False
        self.name = name
        self._bus = bus

    def drive(self, *, low: bool) -> None:
        self._bus.move(self, low)

    def is_high(self) -> bool:
        assert self._bus.is_requested
        return self._bus.level(self)


class Bus:
    """Two wires with a chip on them, and RESET; records every edge that the recovery makes."""

    def __init__(self, chip: Chip, *, scl_stuck: bool = False, has_reset: bool = True) -> None:
        self.clock = VirtualClock()
        self.edges: list[tuple[int, str, bool]] = []
        self.stops = 0
        self.is_requested = False
        self._chip = chip
        self._scl_stuck = scl_stuck
        self._has_reset = has_reset
        self.scl, self.sda = Wire(self, "scl"), Wire(self, "sda")
        self.recovery = GpioRecovery(self, self.clock)

    def level(self, wire: Wire) -> bool:
        is_pulled = self._scl_stuck if wire is self.scl else self._chip.sda_low
        return not (wire.is_low or is_pulled)

    def move(self, wire: Wire, low: bool) -> None:
        assert self.is_requested
        before = self.level(self.scl), self.level(self.sda)
        wire.is_low = low
        self.edges.append((self.clock.now_ns(), wire.name, low))
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
    def _request(self, *lines: Wire) -> Iterator[tuple[OpenDrainLine, ...]]:
        self.is_requested = True
        yield lines
        assert not any(line.is_low for line in lines)
        self.is_requested = False

    @contextmanager
    def request_scl_sda(self) -> Iterator[tuple[OpenDrainLine, OpenDrainLine]]:
        with self._request(self.scl, self.sda):
            yield self.scl, self.sda

    @contextmanager
    def _request_reset(self) -> Iterator[OpenDrainLine]:
        with self._request(line := Wire(self, "reset")):
            yield line

    def request_reset(self) -> Any:
        return self._request_reset() if self._has_reset else None


@pytest.mark.parametrize("clocks", [*range(RECOVERY_CLOCKS + 1), FOREVER])
def test_a_chip_that_holds_sda_for_up_to_nine_clocks_is_freed(clocks: int) -> None:
    bus = Bus(Chip(clocks))
    is_freed = clocks <= RECOVERY_CLOCKS
    # UM10204 3.1.16: nine clocks; and no more of them than needed, the STOP's among them
    assert bus.recovery.send_recovery_clocks() == is_freed
    assert bus.clocks == (clocks + 1 if is_freed else RECOVERY_CLOCKS)
    assert bus.stops == int(is_freed)
    assert not bus.is_requested
    assert bus.clock.now_ns() < 1_000_000
    # SDA is not driven before the STOP, and no two edges are closer than half a period of 100 kHz.
    before_stop = bus.edges[: 2 * min(clocks, RECOVERY_CLOCKS)]
    assert {name for _, name, _ in before_stop} <= {"scl"}
    times_ns = [t_ns for t_ns, _, _ in bus.edges]
    assert times_ns[0] >= 5_000
    assert all(b - a >= 5_000 for a, b in pairwise(times_ns))


def test_scl_that_is_stuck_low_is_not_clocked() -> None:
    bus = Bus(Chip(), scl_stuck=True)
    assert not bus.recovery.send_recovery_clocks()
    assert bus.edges == []
    assert bus.clock.now_ns() < 100_000
    assert not bus.is_requested


@given(data=st.lists(st.integers(0, 255), min_size=1, max_size=4), bit=st.integers(0, 8))
def test_a_chip_interrupted_in_any_bit_of_any_byte_is_freed(data: list[int], bit: int) -> None:
    chip = Sender(data, bit)
    bus = Bus(chip)
    assert bus.recovery.send_recovery_clocks()
    assert not chip.is_sending
    assert bus.clocks <= RECOVERY_CLOCKS + 1


def test_the_reset_of_the_muxes_is_low_for_ten_microseconds() -> None:
    bus = Bus(Chip())
    assert bus.recovery.reset_muxes()
    (begin_ns, *pulled), (end_ns, *released) = bus.edges
    assert (pulled, released) == (["reset", True], ["reset", False])
    assert end_ns - begin_ns == 10_000
    without = Bus(Chip(), has_reset=False)
    assert not without.recovery.reset_muxes()
    assert without.clock.now_ns() == 0


def test_a_scene_without_recovery_has_none() -> None:
    assert open_gpio_recovery(None, VirtualClock()) is None
