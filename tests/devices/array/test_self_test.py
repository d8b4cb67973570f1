"""Identification and measurement of tiles before the first frame."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from smbus2 import i2c_msg

from devices.array import self_test
from devices.array.self_test import (
    WireTiming,
    find_tiles_on_all_channels,
    identify_tiles,
    measure_conversion_ns,
    measure_wire_timing,
)
from devices.buses.i2c import I2cBus
from devices.buses.usb_adapters import UsbAdapter
from devices.clock import VirtualClock
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, Mpl115a2Part
from devices.emulation.parts import make_rng
from devices.errors import BusFaultError, TileSetupError
from devices.scene.emulation_sections import ReadDuringConversion
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP
from tests.builders.scenes import make_scene
from tests.devices.rigs import FOUR, ONE, TWO_MUXES, Plugs, Wires, hesitating

THIRD = (0x3000, 0xB000, 0xC000, 0x3000)


# Identification


def test_every_tile_is_identified_in_the_order_of_the_scene() -> None:
    plugs: Plugs = ((0x73, 7), (0x70, 2), (0x73, 0))
    scene = make_scene(plugs)
    wires = Wires(plugs, words={0: FORUM_CHIP, 1: DATA_SHEET_CHIP, 2: THIRD})
    found = identify_tiles(wires.bus, scene.tile)
    assert [tile.serial for tile in found] == ["T01", "T02", "T03"]
    assert [(tile.mux, tile.channel) for tile in found] == list(plugs)
    assert [tile.registers for tile in found] == [FORUM_CHIP, DATA_SHEET_CHIP, THIRD]
    assert [(t.x_m, t.y_m, t.z_m) for t in found] == [(t.x_m, t.y_m, t.z_m) for t in scene.tile]
    # Before a measurement exactly the data sheet's: it is printed and stored in files.
    assert [tile.conversion_ms for tile in found] == [1.6] * 3


def test_coefficients_are_read_three_times_from_each_tile_alone_whatever_is_open() -> None:
    wires = Wires(TWO_MUXES, words={0: FORUM_CHIP, 3: FORUM_CHIP})
    for mux in (0x70, 0x73):  # another program used the bus before
        wires.adapter.i2c_rdwr(i2c_msg.write(mux, [0xFF]))
    open_at_reads = []

    def before(_: int, messages: tuple[i2c_msg, ...]) -> None:
        if len(messages) == 2:
            masks = [(m.address, m.connected_mask) for m in wires.muxes if m.connected_mask]
            open_at_reads.append(masks)

    wires.on_transaction = before
    found = identify_tiles(wires.bus, make_scene(TWO_MUXES).tile)
    alone = [[(mux, 1 << channel)] for mux, channel in TWO_MUXES]
    assert open_at_reads == [plug for plug in alone for _ in range(3)]
    words = [tile.registers for tile in found]
    assert words == [FORUM_CHIP, DATA_SHEET_CHIP, DATA_SHEET_CHIP, FORUM_CHIP]
    # Of a scene without tiles on an open mux, too.
    wires.adapter.i2c_rdwr(i2c_msg.write(0x73, [0xFF]))
    assert identify_tiles(wires.bus, make_scene(ONE).tile)[0].registers == FORUM_CHIP


def test_an_absent_tile_an_absent_mux_and_another_part_are_named_with_their_plug() -> None:
    wires = Wires(TWO_MUXES, words={3: (0, 0, 0, 0)})
    with wires.fault("no_answer", "T03"), pytest.raises(TileSetupError) as caught:
        identify_tiles(wires.bus, make_scene(TWO_MUXES).tile)
    assert caught.value.where == "tile T03 (mux 0x73 channel 0)"
    assert "does not answer" in caught.value.what
    assert "Plug it in" in caught.value.remedy
    with pytest.raises(TileSetupError) as caught:
        identify_tiles(wires.bus, make_scene(((0x74, 6),)).tile)
    assert caught.value.where == "tile T01 (mux 0x74 channel 6)"
    assert "0x74" in caught.value.what
    with pytest.raises(TileSetupError, match="no MPL115A2") as caught:
        identify_tiles(wires.bus, make_scene(TWO_MUXES).tile)
    assert caught.value.where == "tile T04 (mux 0x73 channel 1)"


def test_a_bus_that_fails_at_the_start_is_no_fault_of_a_tile() -> None:
    wires = Wires(FOUR)
    with wires.fault("scl_low"), pytest.raises(BusFaultError):
        identify_tiles(wires.bus, make_scene().tile)


# Search


def test_tiles_are_found_on_every_channel_of_every_mux() -> None:
    plugs: Plugs = ((0x70, 1), (0x72, 0), (0x72, 7), (0x77, 3))
    wires = Wires(plugs, words={1: FORUM_CHIP, 2: THIRD, 3: (0, 0, 0, 0)})
    found = find_tiles_on_all_channels(wires.bus, {})
    assert [(plug.mux, plug.channel) for plug in found] == list(plugs)
    words = [plug.registers for plug in found]
    assert words == [DATA_SHEET_CHIP, FORUM_CHIP, THIRD, None]
    assert [plug.problem for plug in found[:3]] == [""] * 3
    assert "no MPL115A2" in found[3].problem


def test_no_tile_is_found_on_an_empty_bus_and_a_stuck_one_is_an_error() -> None:
    wires = Wires(FOUR)
    with wires.fault("sda_high"):
        assert find_tiles_on_all_channels(wires.bus, {}) == ()
    # hardware.md 3.2: an SDA that is stuck low looks like an answer at every address
    with wires.fault("sda_low"), pytest.raises(BusFaultError, match="8 multiplexers") as caught:
        find_tiles_on_all_channels(wires.bus, {})
    assert "SDA is stuck low" in caught.value.remedy


# Bus clock


@pytest.mark.parametrize("overhead_us", [0, 60, 160])
@pytest.mark.parametrize("scl_hz", [100_000, 250_000, 400_000])
def test_the_bus_clock_and_the_overhead_of_a_transaction_are_measured(
    scl_hz: int, overhead_us: int
) -> None:
    wires = Wires(FOUR, scl_hz)
    rng = make_rng("overhead")

    def take_time(_: int, __: tuple[i2c_msg, ...]) -> None:
        # Some transactions are late, as on a busy machine.
        late_us = 2_000 if overhead_us and rng.random() < 0.05 else 0
        wires.clock.sleep_until_ns(wires.clock.now_ns() + (overhead_us + late_us) * 1000)

    wires.on_transaction = take_time
    found = measure_wire_timing(wires.bus, wires.clock, wires.infos[2])
    assert found.scl_hz == pytest.approx(scl_hz, rel=0.01)
    assert found.transaction_overhead_s == pytest.approx(
        overhead_us * 1e-6, abs=5e-6 if overhead_us else 1e-6
    )


# Conversion time


def noisy(label: str) -> Callable[[int], tuple[int, int]]:
    """Return the sense of a healthy part: one in nine readings equals the one before.

    Source: hardware.md 1.3.
    """
    rng = make_rng(label)
    return lambda _: (
        round(410 + 1.3 * rng.standard_normal()),
        round(507.3 + 0.5 * rng.standard_normal()),
    )


def part_with(
    tc_ns: int,
    mode: ReadDuringConversion,
    sense: Callable[[int], tuple[int, int]],
    scl_hz: int = 400_000,
) -> Wires:
    wires = Wires(ONE, scl_hz)
    part = EmulatedMpl115a2(Mpl115a2Part(DATA_SHEET_CHIP, tc_ns, sense), mode)
    wires.tiles[0] = part
    wires.muxes[0]._devices = ((0, part),)
    wires.adapter._devices_by_routing.clear()
    return wires


def measure_ns(wires: Wires, tile: int = 0, clock: VirtualClock | None = None) -> int | None:
    timing = WireTiming(wires.scl_hz, 0.0)
    return measure_conversion_ns(wires.bus, clock or wires.clock, wires.infos[tile], timing)


@settings(max_examples=40)
@given(
    jitter_us=st.sampled_from([0.0, 5.0, 50.0, 500.0, 5000.0]),
    scl_hz=st.sampled_from([400_000, 100_000]),
    label=st.integers(0, 10**6).map(str),
)
def test_a_bus_clock_is_right_or_said_to_be_hidden(
    jitter_us: float, scl_hz: int, label: str
) -> None:
    """A USB adapter takes milliseconds a transaction, some more and some less."""
    wires, rng = part_with(1_600_000, "stale", noisy(label), scl_hz), make_rng(label)
    wires.after_transaction = lambda: wires.clock.sleep_until_ns(
        wires.clock.now_ns() + 2_000_000 + round(1e3 * jitter_us * rng.exponential())
    )
    found = measure_wire_timing(wires.bus, wires.clock, wires.infos[0])
    assert found.is_scl_measured or jitter_us > 5.0
    assert not found.is_scl_measured or jitter_us < 5000.0
    assert 0.0019 < found.transaction_overhead_s < 0.0021 + 2e-6 * jitter_us
    if found.is_scl_measured:
        assert found.scl_hz == pytest.approx(scl_hz, rel=0.25)
    else:  # nor is a conversion timed: the data sheet's longest is safe
        assert measure_conversion_ns(wires.bus, wires.clock, wires.infos[0], found) == 3_000_000


def test_the_frames_of_usb_are_no_slow_bus_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    adapter = UsbAdapter("/dev/i2c-5", "i2c-tiny-usb", "1c40:0534", "")
    monkeypatch.setattr(self_test, "find_adapter", {"/dev/i2c-5": adapter}.get)
    wires = part_with(1_600_000, "stale", noisy("usb"))
    wires.after_transaction = lambda: wires.clock.sleep_until_ns(
        -(-wires.clock.now_ns() // 1_000_000) * 1_000_000
    )
    found = measure_wire_timing(I2cBus(wires, "/dev/i2c-5"), wires.clock, wires.infos[0])
    assert not found.is_scl_measured


@settings(max_examples=12, deadline=None)
@given(
    tc_ns=st.integers(1_200_000, 2_999_999),
    mode=st.sampled_from(["stale", "abort", "torn"]),
    scl_hz=st.sampled_from([400_000, 100_000]),
    label=st.integers(0, 10**6).map(str),
)
@example(2_999_000, "stale", 400_000, "long")
def test_a_conversion_time_is_measured_slightly_too_long_and_never_too_short(
    tc_ns: int, mode: ReadDuringConversion, scl_hz: int, label: str
) -> None:
    found_ns = measure_ns(part_with(tc_ns, mode, noisy(label), scl_hz))
    assert found_ns is not None
    assert tc_ns <= found_ns
    # At 100 kHz the address of a read takes 0.29 ms, which cannot be distinguished.
    address_ns = 29 * 1e9 / scl_hz if scl_hz < 400_000 else 0
    assert found_ns <= min(3_000_000, 1.015 * tc_ns + address_ns), "3 ms is the data sheet's"


@pytest.mark.parametrize("mode", ["stale", "abort", "torn"])
def test_every_conversion_is_read_once_so_that_no_read_can_abort_it(
    mode: ReadDuringConversion,
) -> None:
    wires = part_with(1_700_000, mode, noisy("once"))
    measure_ns(wires)
    transfers = [entry for entry in wires.log if entry.startswith("60")]
    assert transfers == ["60<1200", "60<00 60>4"] * (len(transfers) // 2)
    assert len(transfers) > 20


def test_a_tile_is_measured_alone_whatever_is_open() -> None:
    wires = Wires(TWO_MUXES, tc_ns=[1_400_000, 1_500_000, 2_400_000, 2_300_000])
    for tile, label in zip(wires.tiles, "abcd", strict=True):
        conversion_ns = tile._silicon.conversion_ns
        tile._silicon = Mpl115a2Part(DATA_SHEET_CHIP, conversion_ns, noisy(label))
    for i in (0, 2, 1, 3, 3, 0, 2, 1):
        wires.adapter.i2c_rdwr(i2c_msg.write(0x70, [0xFF]))
        wires.adapter.i2c_rdwr(i2c_msg.write(0x73, [0xFF]))
        found_ns = measure_ns(wires, i)
        assert found_ns is not None
        assert wires.tc_ns[i] <= found_ns <= 1.015 * wires.tc_ns[i]


def test_a_part_of_constant_counts_is_not_measured() -> None:
    assert measure_ns(part_with(1_600_000, "stale", lambda _: (410, 507))) is None


def test_a_machine_that_sleeps_too_long_measures_too_long_and_never_too_short() -> None:
    wires = part_with(1_600_000, "abort", noisy("late"))

    class LateClock(VirtualClock):
        def now_ns(self) -> int:
            return wires.clock.now_ns()

        def sleep_until_ns(self, t_ns: int) -> None:
            wires.clock.sleep_until_ns(max(t_ns + 80_000, wires.clock.now_ns()))

    found_ns = measure_ns(wires, clock=LateClock())
    assert found_ns is not None
    assert 1_600_000 <= found_ns <= 1.015 * 1_600_000 + 80_000


@pytest.mark.parametrize("mode", ["stale", "abort", "torn"])
def test_a_busy_machine_never_measures_too_short(mode: ReadDuringConversion) -> None:
    for seed in range(30):
        wires = part_with(1_600_000, mode, noisy(f"hesitates {seed}"))
        hesitating(wires, seed, least_ns=100_000)
        found_ns = measure_ns(wires)
        assert found_ns is not None
        assert 1_600_000 <= found_ns <= 1.02 * 1_600_000
