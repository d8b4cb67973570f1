"""One emulated MCP3208, clocked as its three wires clock it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import VirtualClock
from devices.emulation.chips.mcp3208 import EmulatedMcp3208, InputVoltages, make_amplifier
from devices.scene.hardware_sections import ReferenceSection

VREF_V = 4.096  # one count is one millivolt


def chip(volts: InputVoltages, *, floats_high: bool = True) -> EmulatedMcp3208:
    return EmulatedMcp3208(volts, VirtualClock(), vref_v=VREF_V, floats_high=floats_high)


def with_counts(counts: int, *, floats_high: bool = True) -> EmulatedMcp3208:
    return chip(lambda channel, t_ns: counts / 1000, floats_high=floats_high)


def ramp(channel: int, t_ns: int) -> float:
    """Return n tenths of a volt and a bit for input n."""
    return 0.1 * channel + 0.017


CHANNEL = st.integers(0, 7)
COUNTS = st.integers(0, 4095)


@given(CHANNEL, COUNTS)
def test_both_framings_give_the_same_value(channel: int, counts: int) -> None:
    device = chip(lambda c, _: counts / 1000 if c == channel else 0.0)
    # hardware.md 6, both lines
    rx = device.xfer2([0x06 | channel >> 2, (channel & 3) << 6, 0])
    assert (rx[1] & 0x0F) << 8 | rx[2] == counts
    rx = device.xfer2([0x60 | channel << 2, 0, 0])
    assert rx[1] << 4 | rx[2] >> 4 == counts


@given(CHANNEL, COUNTS)
def test_the_framing_of_an_mcp3008_loses_two_bits(channel: int, counts: int) -> None:
    # hardware.md 6, the trap: its mask widened from 3 to 15 makes it look right, and it is not
    request = [1, (8 + channel) << 4, 0]
    rx = with_counts(counts, floats_high=False).xfer2(list(request))
    assert (rx[1] & 15) << 8 | rx[2] == counts >> 2
    # The widened mask includes the sampling clock, in which the line is not driven.
    rx = with_counts(counts, floats_high=True).xfer2(list(request))
    assert (rx[1] & 15) << 8 | rx[2] == 2048 + (counts >> 2)


@given(st.integers(0, 60), CHANNEL, COUNTS)
def test_the_start_bit_may_stand_anywhere(zeros: int, channel: int, counts: int) -> None:
    bits = f"{'0' * zeros}11{channel:03b}".ljust(88, "0")
    sent = [int(bits[i : i + 8], 2) for i in range(0, len(bits), 8)]
    received = "".join(f"{byte:08b}" for byte in with_counts(counts).xfer2(sent))
    driven = zeros + 6  # start, four of configuration, one of sampling
    assert received[:driven] == "1" * driven, "the chip drives nothing before the null bit"
    msb_first = f"{counts:012b}"
    # DS figure 5-2: then the same the other way round, from B1 up, then zeros
    expected = "0" + msb_first + msb_first[-2::-1] + "0" * 88
    assert received[driven:] == expected[: len(bits) - driven]


@pytest.mark.parametrize("data", [[0, 0, 0], [0] * 40, [0, 0, 1], [0, 0, 0x1F]])
def test_the_line_is_not_driven_without_a_start_bit_and_enough_clocks_after_it(
    data: list[int],
) -> None:
    assert with_counts(1234).xfer2(list(data)) == [0xFF] * len(data)
    assert with_counts(1234, floats_high=False).xfer2(list(data)) == [0] * len(data)


def test_a_chip_select_begins_a_new_conversion() -> None:
    device = with_counts(0xABC)
    device.xfer2([0x06])  # interrupted in its configuration
    assert device.xfer2([0x06, 0, 0])[1:] == [0xEA, 0xBC]


@pytest.mark.parametrize(
    ("number", "plus", "minus"),
    # DS table 5-2
    [(0, 0, 1), (1, 1, 0), (2, 2, 3), (3, 3, 2), (4, 4, 5), (5, 5, 4), (6, 6, 7), (7, 7, 6)],
)
def test_differential_inputs_are_pairs_and_negative_ones_read_zero(
    number: int, plus: int, minus: int
) -> None:
    rx = chip(ramp).xfer2([0x04 | number >> 2, (number & 3) << 6, 0])
    assert (rx[1] & 15) << 8 | rx[2] == max(0, 100 * (plus - minus))


@pytest.mark.parametrize(
    ("volts", "counts"),
    [(-3.0, 0), (0.0, 0), (0.00049, 0), (0.00051, 1), (4.0951, 4095), (9.0, 4095)],
)
def test_a_count_begins_half_a_step_below_its_voltage_and_is_limited(
    volts: float, counts: int
) -> None:
    rx = chip(lambda channel, t_ns: volts).xfer2([0x06, 0, 0])
    assert (rx[1] & 15) << 8 | rx[2] == counts


def test_a_transfer_takes_its_bits_and_samples_at_the_end_of_the_sampling_clock() -> None:
    clock = VirtualClock(5_000)
    asked: list[tuple[int, int]] = []

    def volts(channel: int, t_ns: int) -> float:
        asked.append((channel, t_ns))
        return 1.0

    device = EmulatedMcp3208(volts, clock, max_speed_hz=1_000_000)
    device.xfer2([0x06, 0x80, 0])
    assert clock.now_ns() == 5_000 + 24_000
    # The start bit is bit 5; SGL/DIFF, D2, D1, D0; the sampling clock is bit 10, and ends at 11.
    assert asked == [(2, 5_000 + 11_000)]
    EmulatedMcp3208(volts, clock, max_speed_hz=500_000).xfer2([0x60, 0, 0])
    assert clock.now_ns() == 29_000 + 48_000
    # Here the start bit is bit 1, and a bit takes twice as long.
    assert asked[1] == (0, 29_000 + 14_000)


def test_received_bytes_replace_the_list_as_in_spidev() -> None:
    data = [0x06, 0, 0]
    assert with_counts(0x123).xfer2(data) is data
    assert data[1:] == [0xE1, 0x23]


def test_the_amplifier_is_the_inverse_of_the_scenes_scale() -> None:
    scene = ReferenceSection(channel=2, zero_v=1.65, n_per_v=-30.0)
    volts = make_amplifier(lambda t_ns: t_ns / 1000, scene)
    assert volts(2, 0) == 1.65
    assert volts(2, 15_000) == pytest.approx(1.15)
    assert volts(3, 15_000) == 0.0
    noises = iter([0.3, -0.6])
    noisy = make_amplifier(lambda t_ns: 0.0, scene, noise_n=lambda: next(noises))
    assert [noisy(2, 0), noisy(2, 0)] == pytest.approx([1.64, 1.67])
