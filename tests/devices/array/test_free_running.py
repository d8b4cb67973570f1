"""Tiles with a BMP581, which converts by itself: instants, faults, places, and the bus budget."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.array.schedules import compute_frame_s
from devices.array.startup import ReadyArray, prepare_array
from devices.array.tile import ConversionClock
from devices.buses.i2c import open_bus
from devices.chips import bmp581
from devices.clock import VirtualClock
from devices.emulation.chips.bmp581 import EmulatedBmp581
from devices.emulation.world import World
from devices.errors import SceneError, TileSetupError
from devices.flags import TileFlag
from devices.frames import NOT_READ
from devices.scene.scene_file import Scene, load_scene, replace_chips, validate_scene


def make_scene(name: str = "standing", **tile: Any) -> Scene:
    scene = replace_chips(load_scene(name), "bmp581")
    content = scene.model_dump()
    content["tile"] = [each | tile for each in content["tile"]]
    return validate_scene(content, where="test")


class Rig:
    """An emulated foot of BMP581 tiles, and its array."""

    def __init__(self, scene: Scene) -> None:
        self.clock = VirtualClock()
        self.world = World(scene, self.clock)
        self.clock.sleep_until_ns(10_000_000)
        bus = open_bus("emulated", self.world.i2c_adapter)
        self.ready: ReadyArray = prepare_array(bus, scene, self.clock)
        self.array = self.ready.array

    def chip(self, tile: int) -> EmulatedBmp581:
        chip = self.world.chips[tile]
        assert isinstance(chip, EmulatedBmp581)
        return chip

    def scan(self, frames: int) -> list[list[int]]:
        """Scan frames; return their tile flags."""
        return [self.array.scan_frame().tile_flags for _ in range(frames)]


@given(
    st.floats(0.95, 1.05),
    st.floats(0.0, 1.0),
    st.floats(0.001, 0.02),
    st.floats(-0.001, 0.001),
)
def test_the_clock_of_a_part_is_followed_by_the_number_of_its_conversions(
    factor: float, phase: float, slower: float, measured: float
) -> None:
    """Reads a little slower than conversions bound their ends to the difference."""
    period_ns = 2_000_000 * factor
    clock = ConversionClock(round(period_ns * (1 + measured)))
    read_ns = 1_000_000_000.0
    counted = 0
    errors_ns = []
    for _ in range(3000):
        ended = int((read_ns - phase * period_ns) // period_ns)
        estimated_ns = clock.count_conversions(ended - counted, round(read_ns), round(read_ns))
        errors_ns.append(estimated_ns - (ended + phase) * period_ns)
        counted = ended
        read_ns += period_ns * (1 + slower)
    assert np.abs(errors_ns[2000:]).max() < 0.06 * period_ns


def test_samples_of_free_running_tiles_have_their_instants() -> None:
    rig = Rig(make_scene("rolling"))
    half_ns = bmp581.CONVERSION_P_NS[0] // 2
    ends_ns: list[list[tuple[int, int]]] = [[] for _ in rig.world.chips]
    for tile, ends in enumerate(ends_ns):
        chip = rig.chip(tile)

        def note(
            begin_ns: int,
            counts: tuple[int, int],
            _: object,
            ends: list[tuple[int, int]] = ends,
            chip: EmulatedBmp581 = chip,
        ) -> None:
            ends.append((begin_ns + chip._conversion_ns(), counts[0]))

        chip.on_conversion = note
    scans = [rig.array.scan_frame() for _ in range(1500)]
    for tile, ends in enumerate(ends_ns):
        words = [pressure_raw for _, pressure_raw in ends]
        true_ns = {pressure_raw: end_ns for end_ns, pressure_raw in ends}
        errors_ns = [
            scan.convert_stop_ns[tile]
            + rig.array.sample_delay_ns[tile]
            + half_ns
            - true_ns[scan.pressure_raw[tile]]
            for scan in scans[1000:]
            if words.count(scan.pressure_raw[tile]) == 1
        ]
        assert len(errors_ns) > 100
        assert np.abs(errors_ns).max() < 200_000, "unfollowed it would be a millisecond"
        assert np.std(errors_ns) < 60_000


def test_no_reading_of_a_healthy_array_is_flagged_or_repeated() -> None:
    rig = Rig(make_scene())
    scans = [rig.array.scan_frame() for _ in range(500)]
    assert not any(any(scan.tile_flags) for scan in scans)
    words = [scan.pressure_raw[0] for scan in scans]
    assert sum(a == b for a, b in pairwise(words)) < 10


@pytest.mark.parametrize("tiles", [4, 8])
@pytest.mark.parametrize("scl_hz", [400_000, 1_000_000])
@pytest.mark.parametrize("tile", [{}, {"mode": "forced"}, {"oversampling": 4}])
def test_an_array_reaches_the_rate_that_its_bits_allow(
    tiles: int, scl_hz: int, tile: dict[str, Any]
) -> None:
    content = make_scene("insole" if tiles == 8 else "standing", **tile).model_dump()
    content["array"] |= {"scl_hz": scl_hz}
    content["ground"] = {"kind": "none"}
    content["rate_hz"] = 0.0
    rig = Rig(validate_scene(content, where="test"))
    rig.scan(50)
    begin_ns = rig.clock.now_ns()
    rig.scan(400)
    frame_s = (rig.clock.now_ns() - begin_ns) * 1e-9 / 400
    expected_s = compute_frame_s(rig.ready.choice.schedule, rig.ready.timing)
    assert frame_s == pytest.approx(expected_s, rel=0.02)


def test_two_tiles_share_a_channel_without_a_select_between_them() -> None:
    content = make_scene().model_dump()
    content["tile"] = [
        tile | {"channel": index // 2, "address": bmp581.ADDRESSES[index % 2]}
        for index, tile in enumerate(content["tile"])
    ]
    rig = Rig(validate_scene(content, where="test"))
    assert sum(rig.ready.timing.selects) == 2
    assert not any(any(flags) for flags in rig.scan(100))
    pressures = set(rig.array.scan_frame().pressure_raw)
    assert len(pressures) == 4, "each is read at its own address"


def test_a_brown_out_is_flagged_and_the_part_is_set_up_anew() -> None:
    rig = Rig(make_scene())
    rig.scan(20)
    rig.chip(1).interrupt_supply()
    flags = rig.scan(60)
    bad = [frame[1] for frame in flags if frame[1]]
    assert bad
    assert all(flag & TileFlag.UNUSABLE for flag in bad)
    assert not any(any(frame[:1] + frame[2:]) for frame in flags), "the others go on"
    assert flags[-1][1] == 0
    assert rig.array.scan_frame().pressure_raw[1] != NOT_READ


def test_a_part_that_stops_converting_is_noticed_and_started_again() -> None:
    rig = Rig(make_scene())
    rig.scan(20)
    chip = rig.chip(2)
    chip._mode, chip._next_end_ns = bmp581.STANDBY, None  # as after a lost write
    flags = rig.scan(60)
    assert flags[1][2] & TileFlag.NOT_CONVERTED
    assert flags[-1][2] == 0


@pytest.mark.parametrize("fault", ["unplugged", "no_answer"])
def test_a_tile_that_is_silent_for_a_while_comes_back(fault: Any) -> None:
    rig = Rig(make_scene())
    rig.scan(20)
    with rig.world.inject_fault(fault, "T03"):
        flags = rig.scan(20)
        assert flags[-1][2] & TileFlag.NO_ANSWER
        assert not any(any(frame[:2] + frame[3:]) for frame in flags[1:])
    flags = rig.scan(1500)
    assert flags[-1][2] == 0


def test_another_part_in_a_tiles_place_is_named() -> None:
    rig = Rig(make_scene())
    rig.scan(20)
    with rig.world.inject_fault("replaced", "T02"):
        rig.scan(5)
    rig.scan(1500)
    assert rig.array.replaced_serials == ("T02",)
    assert "another part answers" in rig.array.get_warnings()["T02"]


@pytest.mark.parametrize(
    ("register", "value", "message"),
    [(0x01, 0x60, "chip id 0x60, a BME280"), (0x28, 0x06, "memory is damaged")],
)
def test_a_wrong_chip_or_a_damaged_memory_ends_the_start(
    register: int, value: int, message: str
) -> None:
    scene = make_scene()
    clock = VirtualClock()
    world = World(scene, clock)
    clock.sleep_until_ns(10_000_000)
    chip = world.chips[0]
    assert isinstance(chip, EmulatedBmp581)
    chip._registers[register] = value
    with pytest.raises(TileSetupError, match=message):
        prepare_array(open_bus("emulated", world.i2c_adapter), scene, clock)


def test_a_silent_kind_of_chip_does_not_keep_the_other_from_converting() -> None:
    content = load_scene("standing").model_dump()
    first, *others = content["tile"]
    content["tile"] = [first | {"chip": "bmp581", "mode": "forced"}, *others]
    content["array"] |= {"schedule": "simultaneous"}
    rig = Rig(validate_scene(content, where="test"))
    rig.scan(20)
    with rig.world.inject_fault("unplugged", "T01"):
        flags = rig.scan(200)
        assert all(frame[0] & TileFlag.NO_ANSWER for frame in flags[1:])
        assert sum(any(frame[1:]) for frame in flags) < 10


@pytest.mark.parametrize("schedule", ["simultaneous", "per_mux"])
def test_a_broadcast_of_free_running_tiles_is_refused(schedule: str) -> None:
    content = make_scene().model_dump()
    content["array"] |= {"schedule": schedule}
    with pytest.raises(SceneError, match="convert by themselves"):
        Rig(validate_scene(content, where="test"))
