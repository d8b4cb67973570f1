"""The converter's driver on its emulation, and on a line that answers wrongly or not at all."""

from __future__ import annotations

import errno
import os

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from devices.chips.mcp3208 import Mcp3208
from devices.clock import VirtualClock
from devices.emulation.chips.mcp3208 import EmulatedMcp3208
from devices.errors import AdcSilentError, SpiError

VREF_V = 3.3


class Line:
    """A device that answers every transfer with the same three bytes, or fails."""

    def __init__(self, *answer: int, error: OSError | None = None) -> None:
        self.sent: list[list[int]] = []
        self._answer = answer
        self._error = error

    def xfer2(self, data: list[int], /) -> list[int]:
        self.sent.append(list(data))
        if self._error is not None:
            raise self._error
        data[:] = self._answer  # as spidev does
        return data

    def close(self) -> None:
        pass


@given(st.integers(0, 7), st.integers(0, 4095), st.booleans())
@example(3, 0, False)  # a line that is stuck low reads a rail
@example(3, 0, True)
@example(3, 4095, True)
def test_every_count_of_every_channel_is_read(channel: int, counts: int, floats_high: bool) -> None:
    # The other channels have other voltages, so that a wrong channel shows.
    def input_v(asked: int, _: int) -> float:
        return (counts if asked == channel else 4095 - counts) * VREF_V / 4096

    device = EmulatedMcp3208(input_v, VirtualClock(), vref_v=VREF_V, floats_high=floats_high)
    assert Mcp3208(device, where="emulated").read_counts(channel) == counts


@pytest.mark.parametrize("channel", range(8))
def test_a_request_is_the_documented_three_bytes_each_time(channel: int) -> None:
    line = Line(0xFF, 0xEA, 0xBC)  # which it writes into the request, as spidev does
    adc = Mcp3208(line, where="rig")
    # The bits before the null bit are not driven.
    assert [adc.read_counts(channel) for _ in range(3)] == [0xABC] * 3
    # hardware.md 6: tx = [0x06 | ch>>2, (ch & 3) << 6, 0]
    assert line.sent == [[0x06 | channel >> 2, (channel & 3) << 6, 0]] * 3


@pytest.mark.parametrize("answer", [(), (0,), (0, 0x08), (0, 0x08, 0, 0)])
def test_an_answer_of_another_length_is_an_error(answer: tuple[int, ...]) -> None:
    with pytest.raises(SpiError, match=rf"{len(answer)} bytes came\); expected 3 bytes"):
        Mcp3208(Line(*answer), where="rig").read_counts(0)


def test_a_line_that_floats_high_is_no_full_scale() -> None:
    with pytest.raises(AdcSilentError, match="null bit") as caught:
        Mcp3208(Line(0xFF, 0xFF, 0xFF), where="/dev/spidev0.0").read_counts(2)
    assert caught.value.where == "/dev/spidev0.0, channel 2"
    assert isinstance(caught.value, OSError)


def test_a_failed_transfer_is_an_spi_error() -> None:
    error = OSError(errno.ENODEV, os.strerror(errno.ENODEV))
    with pytest.raises(SpiError, match=os.strerror(errno.ENODEV)) as caught:
        Mcp3208(Line(error=error), where="/dev/spidev0.0").read_counts(7)
    assert type(caught.value) is SpiError
    assert caught.value.__cause__ is error
    assert caught.value.where == "/dev/spidev0.0, channel 7"
