"""Faults of BMP581 tiles through the whole acquisition: each is a flag or an error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from devices.array.startup import prepare_array
from devices.buses.i2c import open_bus
from devices.chips import bmp581
from devices.clock import VirtualClock
from devices.emulation.chips import bmp581 as emulation
from devices.emulation.chips.bmp581 import EmulatedBmp581
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.world import World
from devices.errors import TileSetupError
from devices.flags import TileFlag
from devices.scene.emulation_sections import FaultKind
from devices.scene.scene_file import Scene, load_scene, validate_scene
from tests.devices.array.test_free_running import (
    Rig,
    make_scene,
    note_ends,
    scan_instant_errors_ns,
)

TILE = 2
SETTINGS: dict[str, dict[str, Any]] = {
    "continuous": {},
    "filtered": {"oversampling": 4, "filter": 3},
    "forced": {"mode": "forced"},
}


def inject(kind: FaultKind) -> Callable[[Rig], Any]:
    return lambda rig: rig.world.inject_fault(kind, f"T0{TILE + 1}")


@contextmanager
def brown_out(rig: Rig) -> Iterator[None]:
    """A dip of the supply: the part comes back in standby, without settings and results."""
    rig.chip(TILE).interrupt_supply()
    yield


@contextmanager
def lost_mode(rig: Rig) -> Iterator[None]:
    """The part is in standby, with the results and settings that it had."""
    chip = rig.chip(TILE)
    chip._mode, chip._next_end_ns = bmp581.STANDBY, None
    yield


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (inject("unplugged"), TileFlag.NO_ANSWER),
        (inject("no_answer"), TileFlag.NO_ANSWER),
        (inject("all_ones"), TileFlag.IMPLAUSIBLE),
        (inject("stale"), TileFlag.NOT_CONVERTED),
        (brown_out, TileFlag.NOT_CONVERTED | TileFlag.NO_ANSWER),
        (lost_mode, TileFlag.NOT_CONVERTED),
    ],
    ids=["unplugged", "no_answer", "all_ones", "stale", "brown_out", "lost_mode"],
)
def test_a_part_that_is_ill_is_flagged_alone_and_comes_back_with_right_instants(
    fault: Callable[[Rig], Any], expected: TileFlag, settings: str
) -> None:
    rig = Rig(make_scene("rolling", **SETTINGS[settings]))
    ends_ns = note_ends(rig)
    rig.scan(20)
    flags = []
    with fault(rig):
        for _ in range(30):
            scan = rig.array.scan_frame()
            flags.append(scan.tile_flags)
            if not scan.tile_flags[TILE] & TileFlag.UNUSABLE:
                end_ns = ends_ns[TILE].get(scan.pressure_raw[TILE])
                assert end_ns is None or rig.clock.now_ns() - end_ns < 10_000_000, "an old reading"
    ill = [frame[TILE] for frame in flags[1:] if frame[TILE]]
    if settings == "forced" and fault is lost_mode:
        assert not ill, "the next command ends standby"
    else:
        assert any(flag & expected for flag in ill)
    while rig.scan(1)[0][TILE]:
        assert rig.clock.now_ns() < 10**10
    bound_ns = 0.1 * max(rig.array._tile_io.conversions_ns) + 700_000 * (settings == "forced")
    assert np.abs(scan_instant_errors_ns(rig, ends_ns, 50)).max() < bound_ns
    flags += rig.scan(50)
    assert not any(flags[-1])
    assert not any(any(frame[:TILE] + frame[TILE + 1 :]) for frame in flags)


@pytest.mark.parametrize("temperature_every", [1, 10])
def test_an_old_reading_is_told_without_its_temperature(temperature_every: int) -> None:
    content = make_scene("rolling", mode="forced").model_dump()
    content["array"] |= {"temperature_every": temperature_every}
    rig = Rig(validate_scene(content, where="test"))
    rig.scan(20)
    resets = 0
    reset = rig.chip(TILE).interrupt_supply

    def interrupt_supply() -> None:
        nonlocal resets
        resets += 1
        reset()

    rig.chip(TILE).interrupt_supply = interrupt_supply  # type: ignore[method-assign]
    with rig.world.inject_fault("stale", f"T0{TILE + 1}"):
        rig.scan(1)  # its conversion may have ended before
        old_raw = rig.array._last_counts[TILE][0]
        scans = [rig.array.scan_frame() for _ in range(150)]
    assert all(scan.pressure_raw[TILE] != old_raw for scan in scans)
    assert all(scan.tile_flags[TILE] & TileFlag.UNUSABLE for scan in scans)
    assert resets, "it is set up anew"


def test_a_late_conversion_is_flagged(monkeypatch: pytest.MonkeyPatch) -> None:
    """The status may be of an earlier conversion, since it is asked of repeated counts only."""
    rig = Rig(make_scene("rolling", mode="forced"))
    rig.scan(20)
    monkeypatch.setattr(emulation, "_START_UP_NS", (300_000, bmp581.START_UP_MAX_NS))
    before = rig.array.scan_frame()
    late = 0
    for _ in range(300):
        scan = rig.array.scan_frame()
        for tile, raw in enumerate(scan.pressure_raw):
            late += bool(scan.tile_flags[tile] & TileFlag.NOT_CONVERTED)
            is_old = (raw, scan.temperature_raw[tile]) == (
                before.pressure_raw[tile],
                before.temperature_raw[tile],
            )
            assert scan.tile_flags[tile] or not is_old
        before = scan
    assert late > 20


def test_a_conversion_that_ends_behind_its_read_is_read_again() -> None:
    """The status is asked later: without another read an old reading would pass as new."""
    rig = Rig(make_scene("rolling", mode="forced"))
    rig.scan(20)
    io = rig.array._tile_io
    ask = io.has_new_counts
    was_asked = []

    def end_and_ask(tile: int) -> bool:
        if tile == 0:
            was_asked.append(True)
            rig.clock.sleep_until_ns(rig.clock.now_ns() + 5_000_000)
        return ask(tile)

    io.has_new_counts = end_and_ask  # type: ignore[method-assign]
    rig.array._conversion_monitor.wait_ns[:] = [100_000] * 4  # each read is too early
    old_raw = rig.array._last_counts[0][0]
    scan = rig.array.scan_frame()
    assert was_asked
    assert scan.pressure_raw[0] != old_raw
    assert not scan.tile_flags[0]


@pytest.mark.parametrize(
    ("register", "value", "message"),
    [
        (0x01, 0x60, "chip id 0x60, a BME280"),
        (0x28, 0x06, "memory is damaged"),
        (0x28, 0x00, "not ready"),
    ],
)
def test_a_wrong_chip_or_a_damaged_memory_ends_the_start(
    register: int, value: int, message: str
) -> None:
    scene = make_scene()
    world, clock = make_world(scene)
    chip = world.chips[0]
    assert isinstance(chip, EmulatedBmp581)
    chip._registers[register] = value
    with pytest.raises(TileSetupError, match=message) as caught:
        prepare_array(open_bus("emulated", world.i2c_adapter), scene, clock)
    assert "T01" in str(caught.value)


@pytest.mark.parametrize(("register", "value"), [(0x01, 0x51), (0x01, 0x60), (0x28, 0x06)])
def test_a_wrong_chip_or_a_damaged_memory_behind_a_gap_stays_flagged(
    register: int, value: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(make_scene())
    rig.scan(20)
    monkeypatch.setitem(emulation._RESET_VALUES, register, value)
    rig.chip(TILE).interrupt_supply()
    written: list[int] = []
    if register == 0x01:
        monkeypatch.setattr(rig.chip(TILE), "_write", lambda register, _: written.append(register))
    flags = rig.scan(300)
    assert all(frame[TILE] & TileFlag.UNUSABLE for frame in flags)
    assert not any(any(frame[:TILE] + frame[TILE + 1 :]) for frame in flags), "the others go on"
    assert not written, "another chip is not written to"
    assert rig.array.get_warnings().keys() == {f"T0{TILE + 1}"}


def test_another_part_in_a_tiles_place_is_named() -> None:
    rig = Rig(make_scene())
    rig.scan(20)
    with rig.world.inject_fault("replaced", "T02"):
        rig.scan(5)
    for _ in range(30):  # 3 s
        if rig.array.replaced_serials:
            break
        rig.scan(50)
    assert rig.array.replaced_serials == ("T02",)
    assert "another part answers" in rig.array.get_warnings()["T02"]


def make_world(scene: Scene) -> tuple[World, VirtualClock]:
    clock = VirtualClock()
    world = World(scene, clock)
    clock.sleep_until_ns(10_000_000)
    return world, clock


def make_mixed_scene(**first: Any) -> Scene:
    content = load_scene("standing").model_dump(exclude_none=True)
    first_tile, *others = content["tile"]
    content["tile"] = [first_tile | {"chip": "bmp581", **first}, *others]
    return validate_scene(content, where="test")


def swap_plugs(world: World, one: int, other: int) -> None:
    """Exchange the plugs of two tiles behind one mux."""
    adapter = world.i2c_adapter
    (mux,) = adapter._muxes
    assert isinstance(mux, EmulatedTca9548a)
    plugs = list(mux._devices)
    channels = {one: plugs[other][0], other: plugs[one][0]}
    mux._devices = tuple((channels.get(i, plug[0]), plug[1]) for i, plug in enumerate(plugs))
    adapter._devices_by_routing.clear()
    adapter._present_devices = adapter._devices_by_address()


def test_swapped_tiles_of_two_kinds_are_named_at_the_start() -> None:
    scene = make_mixed_scene()
    world, clock = make_world(scene)
    swap_plugs(world, 0, 1)
    with pytest.raises(TileSetupError, match="does not answer") as caught:
        prepare_array(open_bus("emulated", world.i2c_adapter), scene, clock)
    assert "T01" in str(caught.value)


@pytest.mark.parametrize("first", [{}, {"mode": "forced"}])
def test_tiles_of_two_kinds_that_are_swapped_while_running_are_flagged(
    first: dict[str, Any],
) -> None:
    rig = Rig(make_mixed_scene(**first))
    rig.scan(20)
    swap_plugs(rig.world, 0, 1)
    flags = rig.scan(300)
    assert all(frame[0] & frame[1] & TileFlag.NO_ANSWER for frame in flags[1:])
    assert not any(any(frame[2:]) for frame in flags[1:])
    swap_plugs(rig.world, 0, 1)
    assert any(rig.scan(50)[-1] == [0, 0, 0, 0] for _ in range(30))
    assert rig.scan(20) == [[0, 0, 0, 0]] * 20


def test_a_silent_kind_of_chip_does_not_keep_the_other_from_converting() -> None:
    content = make_mixed_scene(mode="forced").model_dump(exclude_none=True)
    content["array"] |= {"schedule": "simultaneous"}
    rig = Rig(validate_scene(content, where="test"))
    rig.scan(20)
    with rig.world.inject_fault("unplugged", "T01"):
        flags = rig.scan(200)
        assert all(frame[0] & TileFlag.NO_ANSWER for frame in flags[1:])
        assert sum(any(frame[1:]) for frame in flags) < 10


@pytest.mark.parametrize("settings", [{"mode": "forced"}, {"filter": 3}])
def test_a_part_that_is_silent_for_seconds_comes_back(settings: dict[str, Any]) -> None:
    rig = Rig(make_scene(**settings))
    rig.scan(20)
    with rig.world.inject_fault("no_answer", "T01"):
        until_ns = rig.clock.now_ns() + 3_000_000_000
        while rig.clock.now_ns() < until_ns:
            assert rig.scan(2)[-1][0] & TileFlag.NO_ANSWER
    assert any(not any(rig.scan(20)[-1]) for _ in range(30))
