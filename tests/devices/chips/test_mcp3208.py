"""The converter's driver on its emulation, and on lines where nobody answers."""

from __future__ import annotations

import errno
import os

import pytest
from hypothesis import given
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


def converter(counts_at: dict[int, int], *, floats_high: bool = True) -> EmulatedMcp3208:
    """A converter whose inputs are at the middle of these counts, the others at ground."""
    return EmulatedMcp3208(
        lambda channel, _: counts_at.get(channel, 0) * VREF_V / 4096,
        VirtualClock(),
        vref_v=VREF_V,
        floats_high=floats_high,
    )


@given(st.integers(0, 7), st.integers(0, 4095), st.booleans())
def test_every_value_of_every_channel_arrives(channel: int, counts: int, floats_high: bool) -> None:
    # The neighbours are at other voltages, so that a wrong channel is seen.
    inputs = {c: 4095 - counts if c != channel else counts for c in range(8)}
    adc = Mcp3208(converter(inputs, floats_high=floats_high), where="emulated")
    assert adc.read_counts(channel) == counts


@pytest.mark.parametrize("answer", [(), (0,), (0, 0x08), (0, 0x08, 0, 0)])
def test_a_transfer_of_another_length_is_an_error(answer: tuple[int, ...]) -> None:
    with pytest.raises(SpiError, match=rf"{len(answer)} bytes came\); expected 3 bytes"):
        Mcp3208(Line(*answer), where="rig").read_counts(0)


@pytest.mark.parametrize("channel", range(8))
def test_a_request_is_the_documented_three_bytes(channel: int) -> None:
    line = Line(0, 0, 0)
    Mcp3208(line, where="rig").read_counts(channel)
    # hardware.md 6: tx = [0x06 | ch>>2, (ch & 3) << 6, 0]
    assert line.sent == [[0x06 | channel >> 2, (channel & 3) << 6, 0]]


def test_a_request_survives_a_library_that_writes_into_it() -> None:
    line = Line(0xFF, 0xEA, 0xBC)
    adc = Mcp3208(line, where="rig")
    assert [adc.read_counts(5) for _ in range(3)] == [0xABC] * 3
    assert line.sent == [[0x07, 0x40, 0]] * 3


@pytest.mark.parametrize("counts", [0, 4095])
def test_both_rails_are_returned_as_they_are(counts: int) -> None:
    assert Mcp3208(converter({3: counts}), where="rig").read_counts(3) == counts


def test_a_line_that_floats_high_is_no_full_scale() -> None:
    with pytest.raises(AdcSilentError, match="null bit") as caught:
        Mcp3208(Line(0xFF, 0xFF, 0xFF), where="/dev/spidev0.0").read_counts(2)
    assert caught.value.where == "/dev/spidev0.0, channel 2"
    assert isinstance(caught.value, OSError)


def test_a_line_that_is_stuck_low_reads_a_rail() -> None:
    assert Mcp3208(Line(0, 0, 0), where="rig").read_counts(0) == 0


def test_bits_before_the_null_bit_are_nobodys() -> None:
    assert Mcp3208(Line(0xFF, 0xE1, 0x23), where="rig").read_counts(0) == 0x123


def test_a_transfer_that_fails_is_an_spi_error() -> None:
    error = OSError(errno.ENODEV, os.strerror(errno.ENODEV))
    with pytest.raises(SpiError, match=os.strerror(errno.ENODEV)) as caught:
        Mcp3208(Line(error=error), where="/dev/spidev0.0").read_counts(7)
    assert type(caught.value) is SpiError
    assert caught.value.__cause__ is error
    assert caught.value.where == "/dev/spidev0.0, channel 7"
