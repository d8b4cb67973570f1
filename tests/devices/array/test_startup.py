"""From a scene to an array that takes frames: what is measured, what is chosen, and why."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from devices.array import schedules
from devices.array.startup import (
    ReadyArray,
    ensure_bus_works,
    identify_and_measure,
    prepare_array,
    reidentify_replaced_tiles,
)
from devices.buses.i2c import I2cBus, open_bus
from devices.clock import VirtualClock
from devices.emulation.parts import ChipProperties, draw_chip
from devices.emulation.world import World
from devices.errors import BusFaultError, BusSetupError, SceneError, TileSetupError
from devices.scene.emulation_sections import FaultKind
from devices.scene.hardware_sections import ScheduleName
from devices.scene.scene_file import Scene, load_scene
from tests.builders.scenes import make_scene
from tests.devices.rigs import ONE, SCHEDULES, Plugs, full

NOISY = {"noise_kpa": 0.165}


def started(scene: Scene, **options: Any) -> tuple[ReadyArray, I2cBus, VirtualClock, World]:
    clock = VirtualClock(3_000_000_000)
    world = World(scene, clock, begins_now=False)
    bus = open_bus("emulated", world.i2c_adapter)
    return prepare_array(bus, scene, clock, **options), bus, clock, world


def rate_hz(ready: ReadyArray, clock: VirtualClock, seconds: float = 0.9) -> float:
    """Up to the first audit, which comes once a second."""
    begin_ns, frames = clock.now_ns(), 0
    while clock.now_ns() < begin_ns + seconds * 1e9:
        ready.array.scan_frame()
        frames += 1
    return frames / (clock.now_ns() - begin_ns) * 1e9


def test_every_part_is_waited_for_as_long_as_it_takes() -> None:
    ready, *_ = started(make_scene(emulation=NOISY))
    for tile, wait_s in zip(ready.tiles, ready.timing.conversions_s, strict=True):
        true_ms = draw_chip(tile.serial, 0).conversion_ns / 1e6
        assert true_ms <= tile.conversion_ms <= 1.015 * true_ms
        assert wait_s == pytest.approx(tile.conversion_ms * 1e-3)
    assert ready.unmeasured_serials == ()


def test_a_wait_that_the_scene_gives_is_not_measured() -> None:
    ready, _, clock, _ = started(make_scene(array={"wait_ms": 2.5, "conversion_ms": 1.6}))
    assert ready.timing.conversions_s == (2.5e-3,) * 4
    assert [tile.conversion_ms for tile in ready.tiles] == [1.6] * 4
    assert clock.now_ns() < 3_200_000_000, "measuring four parts takes longer"


def test_a_part_that_cannot_be_measured_is_given_3_ms_and_named() -> None:
    scene = make_scene(((0x70, 0), (0x70, 1)), array={"schedule": "pipelined"}, emulation=NOISY)
    clock = VirtualClock()
    world = World(scene, clock, begins_now=False)
    world.chips[1]._silicon = type(world.chips[1]._silicon)(
        draw_chip("T02", 0).coefficients.to_words(), 1_600_000, lambda _: (410, 507)
    )
    ready = prepare_array(open_bus("emulated", world.i2c_adapter), scene, clock)
    assert ready.unmeasured_serials == ("T02",)
    assert ready.timing.conversions_s[1] == 3.0e-3
    assert ready.tiles[1].conversion_ms == 1.6, "of the time of its sample nothing is known"
    assert ready.tiles[0].conversion_ms > 1.6


@pytest.mark.parametrize("tiles", [1, 2, 4, 8, 16])
@pytest.mark.parametrize("schedule", SCHEDULES)
def test_the_rate_is_98_parts_in_100_of_what_was_predicted(
    schedule: ScheduleName, tiles: int
) -> None:
    array = {"schedule": schedule, "broadcast_channels": 64}
    ready, _, clock, _ = started(make_scene(full(tiles), array=array, emulation=NOISY))
    for _ in range(5):
        ready.array.scan_frame()
    assert rate_hz(ready, clock) >= 0.98 * ready.predicted_rate_hz


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_healthy_array_flags_nothing_from_its_first_frame_on(schedule: ScheduleName) -> None:
    two_muxes = ((0x70, 0), (0x70, 5), (0x73, 0), (0x73, 1))
    scene = make_scene(two_muxes, array={"schedule": schedule}, emulation=NOISY)
    ready, _, clock, _ = started(scene)
    while clock.now_ns() < 20_000_000_000:
        assert ready.array.scan_frame().tile_flags == [0] * 4
    assert all(set(health.fault_counts) <= {"not_converted"} for health in ready.array.health)


def test_parts_of_1_6_ms_at_400_khz_reach_544_frames_a_second() -> None:
    scene = load_scene("standing")
    ready, _, clock, _ = started(scene, schedule="pipelined")
    stops = []
    while clock.now_ns() < 13_000_000_000:
        stops.append(ready.array.scan_frame().convert_stop_ns[0])
    assert np.median(np.diff(stops)) * 1e-9 == pytest.approx(1 / 544, rel=0.02)
    assert ready.choice.reason == "as requested"


# Which schedule


@pytest.mark.parametrize(
    ("tiles", "schedule"),
    [(1, "simultaneous"), (2, "pipelined"), (8, "pipelined"), (16, "per_mux"), (24, "per_mux")],
)
def test_auto_takes_what_is_best_for_these_tiles_and_says_why(tiles: int, schedule: str) -> None:
    array = {"wait_ms": 1.6, "conversion_ms": 1.6}
    ready, *_ = started(make_scene(full(tiles), array=array))
    assert ready.choice.schedule == schedule
    assert ready.array._schedule is schedules.SCHEDULES[ready.choice.schedule]
    muxes = (tiles + 7) // 8
    assert ready.choice.reason.startswith(
        f"{tiles} tile{'s' * (tiles > 1)} on {muxes} mux{'es' * (muxes > 1)}: {schedule} gives "
    )


def test_auto_takes_the_one_without_skew_if_it_holds_the_rate() -> None:
    ready, *_ = started(make_scene(emulation=NOISY, rate_hz=300.0))
    assert ready.choice.schedule == "simultaneous"
    assert "no skew" in ready.choice.reason
    assert "300 frames/s" in ready.choice.reason
    assert started(make_scene(emulation=NOISY, rate_hz=420.0))[0].choice.schedule == "pipelined"


def test_a_broadcast_of_sixteen_is_refused_and_told_why() -> None:
    array: dict[str, object] = {"schedule": "simultaneous", "wait_ms": 1.6}
    with pytest.raises(SceneError, match="opens 16 channels at once") as caught:
        started(make_scene(full(16), array=array))
    assert "pull-ups" in caught.value.expected
    assert (
        started(make_scene(full(16), array=array | {"broadcast_channels": 16}))[0].predicted_rate_hz
        > 0
    )


def test_what_was_asked_for_goes_before_what_the_scene_says() -> None:
    array = {"schedule": "sequential", "wait_ms": 1.6}
    assert started(make_scene(array=array))[0].choice.schedule == "sequential"
    assert started(make_scene(array=array))[0].choice.reason == "as the scene says"
    ready, *_ = started(make_scene(array=array), schedule="pipelined")
    assert (ready.choice.schedule, ready.choice.reason) == ("pipelined", "as requested")


@pytest.mark.parametrize("asked", ["auto", "simultaneous", "sequential"])
def test_beside_a_reference_force_tiles_are_sampled_with_it(asked: str) -> None:
    array = {"schedule": asked, "wait_ms": 1.6}
    ready, *_ = started(make_scene(array=array), read_reference_n=lambda: 7.0)
    assert ready.choice.schedule == ("sequential" if asked == "sequential" else "simultaneous")
    assert ready.array.scan_frame().reference_n == 7.0


@pytest.mark.parametrize("asked", ["pipelined", "per_mux"])
def test_what_cannot_be_sampled_with_a_reference_force_is_refused(asked: str) -> None:
    with pytest.raises(SceneError, match="beside a reference sensor"):
        started(make_scene(array={"schedule": asked, "wait_ms": 1.6}), read_reference_n=lambda: 7.0)


def test_an_array_that_reads_less_temperature_is_predicted_to_be_faster() -> None:
    plugs: Plugs = full(8)
    array: dict[str, object] = {"schedule": "pipelined", "wait_ms": 1.6, "conversion_ms": 1.6}
    whole = started(make_scene(plugs, array=array))[0].predicted_rate_hz
    less, _, clock, _ = started(
        make_scene(plugs, array=array | {"temperature_every": 10}, emulation=NOISY)
    )
    # hardware.md 4: 435 with four bytes, 515 with two
    assert round(whole) == 435
    assert less.predicted_rate_hz == pytest.approx(1e6 / (8 * 287.5 - 8 * 45 * 0.9), rel=1e-3)
    assert rate_hz(less, clock) >= 0.97 * less.predicted_rate_hz


def test_a_tile_that_is_absent_stops_the_start_and_is_named() -> None:
    scene = make_scene()
    clock = VirtualClock()
    world = World(scene, clock)
    bus = open_bus("emulated", world.i2c_adapter)
    with world.inject_fault("unplugged", "T03"), pytest.raises(TileSetupError, match="T03"):
        prepare_array(bus, scene, clock)


def test_the_250_khz_trap_shows_in_what_is_predicted() -> None:
    keys = {"schedule": "simultaneous", "wait_ms": 1.6}
    trapped, *_ = started(make_scene(array=keys, emulation={"scl_part": 0.625}))
    assert trapped.timing.scl_hz == pytest.approx(250_000, rel=0.01)
    # 373 periods of 4 us, and 1.6 ms
    assert trapped.predicted_rate_hz == pytest.approx(1e6 / (373 * 4 + 1600), rel=0.01)


def test_measuring_leaves_no_tile_with_a_conversion_of_its_own() -> None:
    scene = make_scene(ONE, emulation=NOISY)
    clock = VirtualClock()
    found = identify_and_measure(
        open_bus("emulated", World(scene, clock).i2c_adapter), scene, clock
    )
    assert found.tiles[0].conversion_ms * 1e-3 == pytest.approx(found.timing.conversions_s[0])


# A bus that hangs since the last run


class Recovery:
    """Clocks that bring the lines up, as far as they can tell, and a RESET that may free SDA."""

    def __init__(self, world: World, *, reset_frees: bool = False, taken: bool = False) -> None:
        self.sda_low = world.i2c_adapter.line.sda_low
        self.reset_frees = reset_frees
        self.taken = taken

    def send_recovery_clocks(self) -> bool:
        if self.taken:
            raise BusSetupError("GPIO lines cannot be used (EBUSY)", where="/dev/gpiochip0")
        return True

    def reset_muxes(self) -> bool:
        if self.reset_frees:
            self.sda_low.end_at(0)
        return True


def hanging(scene: Scene) -> tuple[World, I2cBus]:
    world = World(scene, VirtualClock())
    return world, open_bus("emulated", world.i2c_adapter)


@pytest.mark.parametrize("helped", [False, True])
@pytest.mark.parametrize(
    ("kind", "told"), [("sda_low", "SDA is stuck low"), ("scl_low", "the bus failed (ETIMEDOUT)")]
)
def test_a_bus_that_cannot_be_freed_is_told_by_the_wire_that_is_stuck(
    kind: FaultKind, told: str, helped: bool
) -> None:
    world, bus = hanging(scene := make_scene())
    with world.inject_fault(kind), pytest.raises(BusFaultError, match=re.escape(told)) as caught:
        ensure_bus_works(bus, scene, Recovery(world) if helped else None)
    assert ("SDA is stuck low" in str(caught.value)) == (kind == "sda_low")


@pytest.mark.parametrize("taken", [False, True])
def test_a_bus_that_nine_clocks_do_not_move_is_freed_by_reset(taken: bool) -> None:
    world, bus = hanging(scene := make_scene())
    with world.inject_fault("sda_low"):
        ensure_bus_works(bus, scene, Recovery(world, reset_frees=True, taken=taken))
        assert not world.i2c_adapter.line.sda_low(0)


def test_what_kept_a_bus_from_being_freed_is_told() -> None:
    world, bus = hanging(scene := make_scene())
    with world.inject_fault("sda_low"), pytest.raises(BusFaultError) as caught:
        ensure_bus_works(bus, scene, Recovery(world, taken=True))
    assert "could not be freed: /dev/gpiochip0: GPIO lines cannot be used" in str(caught.value)


# Another part


def renewed(scene: Scene, serial: str) -> tuple[ReadyArray, ReadyArray, ChipProperties]:
    """An array before and after one of its tiles was replaced, and the part that is there now."""
    before, bus, clock, world = started(scene)
    with world.inject_fault("replaced", serial):
        before.array.scan_frame()
    for _ in range(100):
        before.array.scan_frame()
    assert before.array.replaced_serials == (serial,)
    return (
        before,
        reidentify_replaced_tiles(bus, scene, clock, before),
        draw_chip(f"{serial}.spare", 0),
    )


def test_a_replaced_part_is_identified_alone_whatever_the_array_left_open() -> None:
    scene = make_scene(((0x70, 0), (0x71, 0)), emulation=NOISY, array={"schedule": "pipelined"})
    _, after, spare = renewed(scene, "T01")
    assert after.tiles[0].coefficient_words == spare.coefficients.to_words()
    assert after.tiles[0].conversion_ms == pytest.approx(spare.conversion_ns / 1e6, rel=0.015)


def test_a_replaced_part_is_identified_and_measured_anew() -> None:
    scene = make_scene(emulation=NOISY, array={"schedule": "pipelined"})
    before, after, spare = renewed(scene, "T02")
    assert after.tiles[1].coefficient_words == spare.coefficients.to_words()
    true_ms = spare.conversion_ns / 1e6
    assert true_ms <= after.tiles[1].conversion_ms <= 1.015 * true_ms
    assert [after.tiles[i] for i in (0, 2, 3)] == [before.tiles[i] for i in (0, 2, 3)]
    assert after.choice == before.choice
    assert after.array.replaced_serials == ()
    for _ in range(500):
        assert after.array.scan_frame().tile_flags == [0] * 4
