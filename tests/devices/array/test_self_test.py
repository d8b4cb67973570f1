"""What is measured over the bus before the first frame, and how near to the truth it is."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from smbus2 import i2c_msg

from devices.array.self_test import (
    WireTiming,
    find_tiles_on_all_channels,
    identify_tiles,
    measure_conversion_ns,
    measure_wire_timing,
)
from devices.buses.i2c import open_bus
from devices.clock import VirtualClock
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, EmulatedPart
from devices.emulation.parts import draw_chip, make_rng
from devices.emulation.world import World
from devices.errors import BusFaultError, TileSetupError
from devices.scene.emulation_sections import ReadDuringConversion
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP
from tests.builders.scenes import make_scene
from tests.devices.rigs import FOUR, ONE, TWO_MUXES, Plugs, Wires, hesitating

THIRD = (0x3000, 0xB000, 0xC000, 0x3000)


# Who is there


def test_every_tile_is_identified_in_the_order_of_the_scene() -> None:
    plugs: Plugs = ((0x73, 7), (0x70, 2), (0x73, 0))
    scene = make_scene(plugs)
    wires = Wires(plugs, words={0: FORUM_CHIP, 1: DATA_SHEET_CHIP, 2: THIRD})
    found = identify_tiles(wires.bus, scene.tile)
    assert [tile.serial for tile in found] == ["T01", "T02", "T03"]
    assert [(tile.mux, tile.channel) for tile in found] == list(plugs)
    assert [tile.coefficient_words for tile in found] == [FORUM_CHIP, DATA_SHEET_CHIP, THIRD]
    assert [(t.x_m, t.y_m, t.z_m) for t in found] == [(t.x_m, t.y_m, t.z_m) for t in scene.tile]


def test_a_conversion_time_that_was_not_measured_is_the_data_sheets() -> None:
    found = identify_tiles(Wires(FOUR).bus, make_scene().tile)
    # Exactly, because it is printed and kept in files.
    assert [tile.conversion_ms for tile in found] == [1.6] * 4


def test_coefficients_are_read_three_times_from_each_tile_alone() -> None:
    wires = Wires(TWO_MUXES)
    open_at_reads = []

    def before(_: int, messages: tuple[i2c_msg, ...]) -> None:
        if len(messages) == 2:
            open_at_reads.append(
                [(m.address, m.connected_mask) for m in wires.muxes if m.connected_mask]
            )

    wires.on_transaction = before
    identify_tiles(wires.bus, make_scene(TWO_MUXES).tile)
    alone = [[(mux, 1 << channel)] for mux, channel in TWO_MUXES]
    assert open_at_reads == [plug for plug in alone for _ in range(3)]


def test_tiles_are_told_apart_although_every_channel_was_left_open() -> None:
    wires = Wires(TWO_MUXES, words={0: FORUM_CHIP, 3: FORUM_CHIP})
    for mux in (0x70, 0x73):  # somebody else used the bus before
        wires.adapter.i2c_rdwr(i2c_msg.write(mux, [0xFF]))
    found = identify_tiles(wires.bus, make_scene(TWO_MUXES).tile)
    assert [t.coefficient_words for t in found] == [
        FORUM_CHIP,
        DATA_SHEET_CHIP,
        DATA_SHEET_CHIP,
        FORUM_CHIP,
    ]


def test_a_tile_that_is_absent_at_start_up_is_named_with_its_plug() -> None:
    wires = Wires(TWO_MUXES)
    with wires.fault("no_answer", "T03"), pytest.raises(TileSetupError) as caught:
        identify_tiles(wires.bus, make_scene(TWO_MUXES).tile)
    assert caught.value.where == "tile T03 (mux 0x73 channel 0)"
    assert "does not answer" in caught.value.what
    assert "Plug it in" in caught.value.remedy


def test_a_mux_that_is_absent_at_start_up_is_named_with_the_tile_behind_it() -> None:
    with pytest.raises(TileSetupError) as caught:
        identify_tiles(Wires(FOUR).bus, make_scene(((0x74, 6),)).tile)
    assert caught.value.where == "tile T01 (mux 0x74 channel 6)"
    assert "0x74" in caught.value.what


def test_a_part_without_coefficients_is_refused_and_named() -> None:
    wires = Wires(FOUR, words={3: (0, 0, 0, 0)})
    with pytest.raises(TileSetupError, match="no MPL115A2") as caught:
        identify_tiles(wires.bus, make_scene().tile)
    assert caught.value.where == "tile T04 (mux 0x70 channel 3)"


def test_coefficients_that_differ_from_read_to_read_are_refused() -> None:
    wires = Wires(ONE)
    reads = 0

    def disturb(_: int, messages: tuple[i2c_msg, ...]) -> None:
        nonlocal reads
        reads += len(messages) == 2
        if reads == 3:
            wires.tiles[0]._registers[0x05] ^= 0x04

    wires.on_transaction = disturb
    with pytest.raises(TileSetupError, match="differ") as caught:
        identify_tiles(wires.bus, make_scene(ONE).tile)
    assert "100 kHz" in caught.value.remedy


def test_a_bus_that_fails_at_start_up_is_no_fault_of_a_tile() -> None:
    wires = Wires(FOUR)
    with wires.fault("scl_low"), pytest.raises(BusFaultError):
        identify_tiles(wires.bus, make_scene().tile)


# What is there, whatever a scene says


def test_every_plug_of_every_mux_is_looked_behind() -> None:
    plugs: Plugs = ((0x70, 1), (0x72, 0), (0x72, 7), (0x77, 3))
    wires = Wires(plugs, words={1: FORUM_CHIP, 2: THIRD})
    found = find_tiles_on_all_channels(wires.bus)
    assert [(plug.mux, plug.channel) for plug in found] == list(plugs)
    assert [plug.coefficient_words for plug in found] == [
        DATA_SHEET_CHIP,
        FORUM_CHIP,
        THIRD,
        DATA_SHEET_CHIP,
    ]
    assert [plug.problem for plug in found] == [""] * 4


def test_a_plug_behind_which_something_else_answers_says_so() -> None:
    found = find_tiles_on_all_channels(Wires(FOUR[:2], words={1: (0, 0, 0, 0)}).bus)
    assert found[1].coefficient_words is None
    assert "no MPL115A2" in found[1].problem


def test_a_bus_without_anybody_is_empty_and_no_error() -> None:
    wires = Wires(FOUR)
    with wires.fault("sda_high"):
        assert find_tiles_on_all_channels(wires.bus) == ()


def test_a_stuck_sda_is_not_taken_for_eight_muxes() -> None:
    # hardware.md 3.2: it looks like success at every address
    wires = Wires(FOUR)
    with wires.fault("sda_low"), pytest.raises(BusFaultError, match="8 multiplexers") as caught:
        find_tiles_on_all_channels(wires.bus)
    assert "SDA is stuck low" in caught.value.remedy


# The wires


@pytest.mark.parametrize("scl_hz", [100_000, 250_000, 400_000])
def test_the_bus_clock_is_measured_within_a_hundredth(scl_hz: int) -> None:
    wires = Wires(FOUR, scl_hz)
    found = measure_wire_timing(wires.bus, wires.clock, wires.infos[2])
    assert found.scl_hz == pytest.approx(scl_hz, rel=0.01)
    assert found.transaction_overhead_s == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("asked_hz", "real_hz"), [(400_000, 250_000), (100_000, 62_500)])
def test_the_250_khz_trap_of_the_raspberry_pi_is_measured(asked_hz: float, real_hz: float) -> None:
    scene = make_scene(ONE, array={"scl_hz": asked_hz}, emulation={"scl_part": 0.625})
    clock = VirtualClock()
    bus = open_bus("emulated", World(scene, clock).i2c_adapter)
    found = measure_wire_timing(bus, clock, identify_tiles(bus, scene.tile)[0])
    assert found.scl_hz == pytest.approx(real_hz, rel=0.01)


@pytest.mark.parametrize("overhead_us", [60, 160])
@pytest.mark.parametrize("scl_hz", [100_000, 400_000])
def test_the_overhead_of_a_transaction_is_told_from_its_bits(scl_hz: int, overhead_us: int) -> None:
    wires = Wires(ONE, scl_hz)
    noise = make_rng("overhead")

    def take_time(_: int, __: tuple[i2c_msg, ...]) -> None:
        # Now and then the host is busy with something else.
        late_us = 2_000 if noise.random() < 0.05 else 0
        wires.clock.sleep_until_ns(wires.clock.now_ns() + (overhead_us + late_us) * 1000)

    wires.on_transaction = take_time
    found = measure_wire_timing(wires.bus, wires.clock, wires.infos[0])
    assert found.scl_hz == pytest.approx(scl_hz, rel=0.01)
    assert found.transaction_overhead_s == pytest.approx(overhead_us * 1e-6, abs=5e-6)


# How long a part converts


def noisy(label: str) -> Callable[[int], tuple[int, int]]:
    """A healthy part's words: one in nine readings is equal to the one before (hardware.md 1.3)."""
    rng = make_rng(label)
    return lambda _: (
        round(410 + 1.3 * rng.standard_normal()),
        round(507.3 + 0.5 * rng.standard_normal()),
    )


def part_with(
    tc_ns: int, mode: ReadDuringConversion, sense: Callable[[int], tuple[int, int]], scl_hz: int
) -> Wires:
    wires = Wires(ONE, scl_hz)
    part = EmulatedMpl115a2(EmulatedPart(DATA_SHEET_CHIP, tc_ns, sense), mode)
    wires.tiles[0] = part
    wires.muxes[0]._channels[0] = part
    wires.adapter._devices_by_routing.clear()
    return wires


@settings(max_examples=12, deadline=None)
@given(
    tc_ns=st.integers(1_200_000, 2_900_000),
    mode=st.sampled_from(["stale", "abort", "torn"]),
    scl_hz=st.sampled_from([400_000, 100_000]),
    label=st.integers(0, 10**6).map(str),
)
def test_a_conversion_time_is_measured_a_little_too_long_and_never_too_short(
    tc_ns: int, mode: ReadDuringConversion, scl_hz: int, label: str
) -> None:
    wires = part_with(tc_ns, mode, noisy(label), scl_hz)
    found = measure_conversion_ns(wires.bus, wires.clock, wires.infos[0], WireTiming(scl_hz, 0.0))
    assert found is not None
    assert tc_ns <= found
    # At 100 kHz the address of a read takes 0.29 ms, which nobody can tell from converting.
    address_ns = 29 * 1e9 / scl_hz
    allowed = 1.015 * tc_ns + (address_ns if scl_hz < 400_000 else 0)
    assert found <= min(3_000_000, allowed)


def test_a_read_that_would_abort_a_conversion_never_comes_twice_and_never_in_a_poll() -> None:
    for mode in ("stale", "abort", "torn"):
        wires = part_with(1_700_000, mode, noisy("once"), 400_000)
        measure_conversion_ns(wires.bus, wires.clock, wires.infos[0], WireTiming(400_000, 0.0))
        transfers = [entry for entry in wires.log if entry.startswith("60")]
        assert transfers == ["60<1200", "60<00 60>4"] * (len(transfers) // 2)
        assert len(transfers) > 20


@pytest.mark.parametrize("tile", [0, 1, 2, 3])
@pytest.mark.parametrize("mode", ["stale", "abort", "torn"])
def test_drawn_parts_are_measured_as_they_are(mode: ReadDuringConversion, tile: int) -> None:
    scene = make_scene(emulation={"noise_kpa": 0.165, "read_during_conversion": mode})
    clock = VirtualClock()
    bus = open_bus("emulated", World(scene, clock, begins_now=False).i2c_adapter)
    info = identify_tiles(bus, scene.tile)[tile]
    found = measure_conversion_ns(bus, clock, info, WireTiming(400_000, 0.0))
    true_ns = draw_chip(info.serial, 0).conversion_ns
    assert found is not None
    assert true_ns <= found <= 1.015 * true_ns


def test_a_tile_is_measured_alone_whatever_another_mux_was_left_with() -> None:
    wires = Wires(TWO_MUXES, tc_ns=[1_400_000, 1_500_000, 2_400_000, 2_300_000])
    for tile, label in zip(wires.tiles, "abcd", strict=True):
        silicon = tile._silicon
        tile._silicon = EmulatedPart(DATA_SHEET_CHIP, silicon.conversion_ns, noisy(label))
    for order in ((0, 2, 1, 3), (3, 0, 2, 1)):
        for i in order:
            wires.adapter.i2c_rdwr(i2c_msg.write(0x70, [0xFF]))
            wires.adapter.i2c_rdwr(i2c_msg.write(0x73, [0xFF]))
            found = measure_conversion_ns(
                wires.bus, wires.clock, wires.infos[i], WireTiming(400_000, 0.0)
            )
            assert found is not None
            assert wires.tc_ns[i] <= found <= 1.015 * wires.tc_ns[i]


def test_a_tile_is_identified_alone_whatever_a_mux_without_tiles_of_the_scene_was_left_with() -> (
    None
):
    wires = Wires(TWO_MUXES, words={0: FORUM_CHIP})
    wires.adapter.i2c_rdwr(i2c_msg.write(0x73, [0xFF]))
    found = identify_tiles(wires.bus, make_scene(ONE).tile)
    assert found[0].coefficient_words == FORUM_CHIP


def test_a_part_whose_words_never_change_is_not_measured() -> None:
    wires = part_with(1_600_000, "stale", lambda _: (410, 507), 400_000)
    assert (
        measure_conversion_ns(wires.bus, wires.clock, wires.infos[0], WireTiming(400_000, 0.0))
        is None
    )


def test_no_conversion_is_allowed_more_than_the_data_sheet_does() -> None:
    wires = part_with(2_999_000, "stale", noisy("long"), 400_000)
    found = measure_conversion_ns(wires.bus, wires.clock, wires.infos[0], WireTiming(400_000, 0.0))
    assert found == 3_000_000


def test_a_machine_that_sleeps_too_long_measures_too_long_and_never_too_short() -> None:
    wires = part_with(1_600_000, "abort", noisy("late"), 400_000)

    class Sleepy(VirtualClock):
        def now_ns(self) -> int:
            return wires.clock.now_ns()

        def sleep_until_ns(self, t_ns: int) -> None:
            wires.clock.sleep_until_ns(max(t_ns + 80_000, wires.clock.now_ns()))

    found = measure_conversion_ns(wires.bus, Sleepy(), wires.infos[0], WireTiming(400_000, 0.0))
    assert found is not None
    assert 1_600_000 <= found <= 1.015 * 1_600_000 + 80_000


@pytest.mark.parametrize("mode", ["stale", "abort", "torn"])
def test_a_machine_that_hesitates_before_a_transfer_never_measures_too_short(
    mode: ReadDuringConversion,
) -> None:
    for seed in range(30):
        wires = part_with(1_600_000, mode, noisy(f"hesitates {seed}"), 400_000)
        hesitating(wires, seed, least_ns=100_000)
        wires_timing = WireTiming(400_000, 0.0)
        found = measure_conversion_ns(wires.bus, wires.clock, wires.infos[0], wires_timing)
        assert found is not None
        assert 1_600_000 <= found <= 1.02 * 1_600_000
