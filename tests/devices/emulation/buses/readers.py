"""A reader of tiles behind multiplexers."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from smbus2 import i2c_msg

from devices.clock import VirtualClock
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, EmulatedPart
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.scene.emulation_sections import ReadDuringConversion
from tests.builders.arrays import DATA_SHEET_CHIP

MUX, OTHER_MUX, TILE = 0x70, 0x71, 0x60
TC_NS = 1_600_000


def chip(
    *results: tuple[int, int],
    words: tuple[int, int, int, int] = DATA_SHEET_CHIP,
    mode: ReadDuringConversion = "stale",
) -> EmulatedMpl115a2:
    """A part whose conversions give `results`, one after another."""
    coming = iter(results)
    return EmulatedMpl115a2(EmulatedPart(words, TC_NS, lambda _: next(coming)), mode)


class Reader:
    """What somebody with smbus2 and the data sheets would write."""

    def __init__(
        self, muxes: dict[int, dict[int, EmulatedMpl115a2]], scl_hz: float = 400_000
    ) -> None:
        self.clock = VirtualClock(5_000_000_000)
        self.muxes = [EmulatedTca9548a(address, tiles) for address, tiles in muxes.items()]
        self.adapter = EmulatedI2cAdapter(self.muxes, self.clock, scl_hz)

    def select(self, mask: int, mux: int = MUX) -> None:
        self.adapter.i2c_rdwr(i2c_msg.write(mux, [mask]))

    def selected(self, mux: int = MUX) -> int:
        message = i2c_msg.read(mux, 1)
        self.adapter.i2c_rdwr(message)
        return bytes(message)[0]

    def convert(self) -> None:
        self.adapter.i2c_rdwr(i2c_msg.write(TILE, [0x12, 0x00]))

    def convert_and_wait(self) -> None:
        self.convert()
        self.wait(TC_NS)

    def wait(self, t_ns: int) -> None:
        self.clock.sleep_until_ns(self.clock.now_ns() + t_ns)

    def read(self, register: int, count: int) -> bytes:
        message = i2c_msg.read(TILE, count)
        self.adapter.i2c_rdwr(i2c_msg.write(TILE, [register]), message)
        return bytes(message)

    def words(self) -> tuple[int, int, int, int]:
        raw = self.read(0x04, 8)
        a0, b1, b2, c12 = (raw[i] << 8 | raw[i + 1] for i in range(0, 8, 2))
        return a0, b1, b2, c12

    def counts(self) -> tuple[int, int]:
        raw = self.read(0x00, 4)
        return (raw[0] << 8 | raw[1]) >> 6, (raw[2] << 8 | raw[3]) >> 6


def alone(part: EmulatedMpl115a2, scl_hz: float = 400_000) -> Reader:
    """One tile on channel 0, selected."""
    reader = Reader({MUX: {0: part}}, scl_hz)
    reader.select(0b1)
    return reader


def refusal(transact: Callable[[], object]) -> int | None:
    with pytest.raises(OSError) as caught:  # noqa: PT011  # the number is what it is about
        transact()
    assert type(caught.value) is OSError, "the kernel knows nothing of our errors"
    return caught.value.errno


def write() -> i2c_msg:
    return i2c_msg.write(TILE, [0x00])


def read() -> i2c_msg:
    return i2c_msg.read(TILE, 4)
