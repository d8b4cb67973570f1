"""From a scene to an array that takes frames: measurements, choice of a schedule, recovery."""

from __future__ import annotations

import re
from typing import Any

import pytest

from devices.array import schedules
from devices.array.schedules import BusTiming
from devices.array.startup import (
    ReadyArray,
    choose_scene_schedule,
    ensure_bus_works,
    prepare_array,
    reidentify_replaced_tiles,
)
from devices.buses.i2c import I2cBus, open_bus
from devices.clock import VirtualClock
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, Mpl115a2Part, draw_chip
from devices.emulation.world import World
from devices.errors import BusFaultError, SceneError
from devices.scene.emulation_sections import FaultKind, ReadDuringConversion
from devices.scene.hardware_sections import AnySchedule, ScheduleName
from devices.scene.scene_file import Scene
from tests.builders.scenes import make_scene
from tests.devices.rigs import FOUR, SCHEDULES, TWO_MUXES, Plugs, ScriptedRecovery, full

NOISY = {"noise_kpa": 0.165}


def started(scene: Scene, **options: Any) -> tuple[ReadyArray, I2cBus, VirtualClock, World]:
    clock = VirtualClock(3_000_000_000)
    world = World(scene, clock, begins_now=False)
    bus = open_bus("emulated", world.i2c_adapter)
    return prepare_array(bus, scene, clock, **options), bus, clock, world


def measure_rate_hz(ready: ReadyArray, clock: VirtualClock) -> float:
    """Return the rate up to the first audit, which comes once a second."""
    begin_ns, frames = clock.now_ns(), 0
    while clock.now_ns() < begin_ns + 900_000_000:
        ready.array.scan_frame()
        frames += 1
    return frames / (clock.now_ns() - begin_ns) * 1e9


@pytest.mark.parametrize("mode", ["stale", "abort", "torn"])
def test_the_wait_for_each_part_is_its_own_conversion_time(mode: ReadDuringConversion) -> None:
    ready, *_ = started(make_scene(emulation=NOISY | {"read_during_conversion": mode}))
    for tile, wait_s in zip(ready.tiles, ready.timing.conversions_s, strict=True):
        true_ms = draw_chip(tile.serial, 0).conversion_ns / 1e6
        assert true_ms <= tile.conversion_ms <= 1.015 * true_ms
        assert wait_s == pytest.approx(tile.conversion_ms * 1e-3)
    assert ready.unmeasured_serials == ()


def test_parts_of_a_scene_convert_in_the_time_that_it_says() -> None:
    ready, *_ = started(make_scene(array={"conversion_ms": 2.5}, emulation=NOISY))
    for tile in ready.tiles:
        assert 2.5 <= tile.conversion_ms <= 1.015 * 2.5


def test_a_wait_of_the_scene_is_not_measured() -> None:
    ready, _, clock, _ = started(make_scene(array={"wait_ms": 2.5, "conversion_ms": 1.6}))
    assert ready.timing.conversions_s == (2.5e-3,) * 4
    assert [tile.conversion_ms for tile in ready.tiles] == [1.6] * 4
    assert clock.now_ns() < 3_200_000_000, "measuring four parts takes longer"


def test_a_part_that_cannot_be_measured_has_a_wait_of_3_ms() -> None:
    scene = make_scene(((0x70, 0), (0x70, 1)), array={"schedule": "pipelined"}, emulation=NOISY)
    clock = VirtualClock()
    world = World(scene, clock, begins_now=False)
    chip = world.chips[1]
    assert isinstance(chip, EmulatedMpl115a2)
    words = draw_chip("T02", 0).coefficients.to_words()
    chip._silicon = Mpl115a2Part(words, 1_600_000, lambda _: (410, 507))
    ready = prepare_array(open_bus("emulated", world.i2c_adapter), scene, clock)
    assert ready.unmeasured_serials == ("T02",)
    assert ready.timing.conversions_s[1] == 3.0e-3
    assert ready.tiles[1].conversion_ms == 1.6, "the instant of its sample is unknown"
    assert ready.tiles[0].conversion_ms > 1.6


@pytest.mark.parametrize("tiles", [1, 4, 16])
@pytest.mark.parametrize("schedule", SCHEDULES)
def test_the_rate_is_98_percent_of_the_predicted_one(schedule: ScheduleName, tiles: int) -> None:
    array = {"schedule": schedule, "broadcast_channels": 64}
    ready, _, clock, _ = started(make_scene(full(tiles), array=array, emulation=NOISY))
    for _ in range(5):
        ready.array.scan_frame()
    assert measure_rate_hz(ready, clock) >= 0.98 * ready.predicted_rate_hz


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_healthy_array_flags_nothing_from_its_first_frame_on(schedule: ScheduleName) -> None:
    scene = make_scene(TWO_MUXES, array={"schedule": schedule}, emulation=NOISY)
    ready, _, clock, _ = started(scene)
    while clock.now_ns() < 9_000_000_000:
        assert ready.array.scan_frame().tile_flags == [0] * 4
    assert all(set(health.fault_counts) <= {"not_converted"} for health in ready.array.health)


# Choice of a schedule


def timing_of(scene: Scene) -> BusTiming:
    return BusTiming(400_000, (1.6e-3,) * len(scene.tile), tuple(tile.mux for tile in scene.tile))


def test_a_broadcast_of_sixteen_channels_is_refused_unless_the_scene_allows_it() -> None:
    array: dict[str, object] = {"schedule": "simultaneous", "wait_ms": 1.6}
    with pytest.raises(SceneError, match="opens 16 channels at once") as caught:
        started(make_scene(full(16), array=array))
    assert "pull-ups" in caught.value.expected
    ready, *_ = started(make_scene(full(16), array=array | {"broadcast_channels": 16}))
    assert ready.predicted_rate_hz > 0


@pytest.mark.parametrize(
    ("scene", "requested", "schedule", "reason"),
    [
        ({"rate_hz": 300.0}, None, "simultaneous", "no skew.*300 frames/s"),
        ({"rate_hz": 420.0}, None, "pipelined", "^4 tiles on 1 mux: pipelined gives 544 "),
        ({"plugs": full(16)}, None, "per_mux", "^16 tiles on 2 muxes: per_mux gives "),
        ({"array": {"schedule": "sequential"}}, None, "sequential", "^as the scene says$"),
        ({"array": {"schedule": "sequential"}}, "pipelined", "pipelined", "^as requested$"),
    ],
)
def test_a_scene_has_the_schedule_that_was_asked_for_or_the_best(
    scene: dict[str, Any],
    requested: AnySchedule | None,
    schedule: ScheduleName,
    reason: str,
) -> None:
    made = make_scene(**scene)
    choice = choose_scene_schedule(made, timing_of(made), requested, has_reference=False)
    assert choice.schedule == schedule
    assert re.search(reason, choice.reason)


@pytest.mark.parametrize(
    ("asked", "schedule", "reason"),
    [
        ("auto", "simultaneous", "^the reference force is read while all tiles convert at once$"),
        ("simultaneous", "simultaneous", "^the reference force is read while all tiles convert"),
        ("sequential", "sequential", "^as the scene says$"),
        ("pipelined", None, "beside a reference sensor"),
        ("per_mux", None, "beside a reference sensor"),
    ],
)
def test_tiles_beside_a_reference_force_are_sampled_with_it(
    asked: AnySchedule, schedule: ScheduleName | None, reason: str
) -> None:
    scene = make_scene(array={"schedule": asked})
    if schedule is None:
        with pytest.raises(SceneError, match=reason):
            choose_scene_schedule(scene, timing_of(scene), has_reference=True)
    else:
        choice = choose_scene_schedule(scene, timing_of(scene), has_reference=True)
        assert choice.schedule == schedule
        assert re.search(reason, choice.reason)


def test_a_schedule_given_beside_a_reference_force_was_requested() -> None:
    scene = make_scene(array={"schedule": "simultaneous"})
    choice = choose_scene_schedule(scene, timing_of(scene), "sequential", has_reference=True)
    assert (choice.schedule, choice.reason) == ("sequential", "as requested")


def test_a_ready_array_has_the_chosen_schedule_and_reads_the_reference_force() -> None:
    scene = make_scene(array={"wait_ms": 1.6})
    ready, *_ = started(scene, schedule="sequential", read_reference_n=lambda: 7.0)
    assert ready.choice.schedule == "sequential"
    assert ready.array._schedule is schedules.SCHEDULES["sequential"]
    assert ready.array.scan_frame().reference_n == 7.0
    ready, *_ = started(scene, schedule="auto", read_reference_n=lambda: 7.0)
    assert ready.choice.schedule == "simultaneous", "sampled with the force"
    with pytest.raises(SceneError, match="beside a reference sensor"):
        started(scene, schedule="pipelined", read_reference_n=lambda: 7.0)


def test_an_array_that_reads_less_temperature_is_faster() -> None:
    plugs: Plugs = full(8)
    array: dict[str, object] = {"schedule": "pipelined", "wait_ms": 1.6, "conversion_ms": 1.6}
    whole = started(make_scene(plugs, array=array))[0].predicted_rate_hz
    less, _, clock, _ = started(
        make_scene(plugs, array=array | {"temperature_every": 10}, emulation=NOISY)
    )
    # hardware.md 4: 435 with four bytes, 515 with two
    assert round(whole) == 435
    assert less.predicted_rate_hz == pytest.approx(1e6 / (8 * 287.5 - 8 * 45 * 0.9), rel=1e-3)
    assert measure_rate_hz(less, clock) >= 0.97 * less.predicted_rate_hz


def test_the_250_khz_trap_shows_in_the_predicted_rate() -> None:
    keys = {"schedule": "simultaneous", "wait_ms": 1.6}
    trapped, *_ = started(make_scene(array=keys, emulation={"scl_part": 0.625}))
    assert trapped.timing.scl_hz == pytest.approx(250_000, rel=0.01)
    # 373 periods of 4 us, and 1.6 ms
    assert trapped.predicted_rate_hz == pytest.approx(1e6 / (373 * 4 + 1600), rel=0.01)


# A bus that is stuck since the last run


@pytest.mark.parametrize("has_recovery", [False, True])
@pytest.mark.parametrize(
    ("kind", "reason"), [("sda_low", "SDA is stuck low"), ("scl_low", "the bus failed (ETIMEDOUT)")]
)
def test_a_bus_that_cannot_be_freed_is_an_error_that_names_the_stuck_wire(
    kind: FaultKind, reason: str, has_recovery: bool
) -> None:
    world = World(scene := make_scene(), clock := VirtualClock())
    bus = open_bus("emulated", world.i2c_adapter)
    recovery = ScriptedRecovery(world.i2c_adapter, clock) if has_recovery else None
    with world.inject_fault(kind), pytest.raises(BusFaultError, match=re.escape(reason)) as caught:
        ensure_bus_works(bus, scene, recovery)
    assert ("SDA is stuck low" in str(caught.value)) == (kind == "sda_low")


def test_a_stuck_bus_is_recovered_or_its_error_names_the_failure_of_the_recovery() -> None:
    world = World(scene := make_scene(), clock := VirtualClock())
    bus = open_bus("emulated", world.i2c_adapter)
    recovery = ScriptedRecovery(world.i2c_adapter, clock, fails=True)
    with world.inject_fault("sda_low"):
        with pytest.raises(BusFaultError, match="could not be freed: gpio: another program has"):
            ensure_bus_works(bus, scene, recovery)
        recovery.reset_frees = True
        ensure_bus_works(bus, scene, recovery)
        assert not world.i2c_adapter.line.sda_low(clock.now_ns())


# A replaced part


@pytest.mark.parametrize(
    ("plugs", "tile"),
    # Two muxes: with any channel left open.
    [(((0x70, 0), (0x71, 0)), 0), (FOUR, 1)],
)
def test_a_replaced_part_is_identified_and_measured_again(plugs: Plugs, tile: int) -> None:
    scene = make_scene(plugs, emulation=NOISY, array={"schedule": "pipelined"})
    before, bus, clock, world = started(scene)
    serial = scene.tile[tile].serial
    with world.inject_fault("replaced", serial):
        before.array.scan_frame()
    for _ in range(100):
        before.array.scan_frame()
    assert before.array.replaced_serials == (serial,)
    after = reidentify_replaced_tiles(bus, scene, clock, before)
    spare = draw_chip(f"{serial}.spare", 0)
    assert after.tiles[tile].registers == spare.coefficients.to_words()
    true_ms = spare.conversion_ns / 1e6
    assert true_ms <= after.tiles[tile].conversion_ms <= 1.015 * true_ms
    others = [i for i in range(len(plugs)) if i != tile]
    assert [after.tiles[i] for i in others] == [before.tiles[i] for i in others]
    assert after.choice == before.choice
    assert after.array.replaced_serials == ()
    for _ in range(200):
        assert after.array.scan_frame().tile_flags == [0] * len(plugs)
