"""A whole emulated foot: what it is made of, what the bus shows of it, and what was true."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from smbus2 import i2c_msg

from devices.array.schedules import BusTiming
from devices.array.self_test import identify_tiles
from devices.array.tile_array import TileArray
from devices.buses.i2c import I2cBus, open_bus
from devices.chips.dynamixel.driver import open_servo
from devices.chips.mpl115a2 import Coefficients, compensate_kpa
from devices.clock import VirtualClock
from devices.emulation.parts import draw_chip, draw_dome
from devices.emulation.world import World
from devices.errors import TileSetupError
from devices.scene.scene_file import load_scene
from tests.builders.scenes import make_scene
from tests.devices.emulation.worlds import EPOCH_NS, TWO, identified, moved_to, switched_on
from tests.devices.rigs import ONE

# Pressure, end to end


def kpa_of(world: World, array: TileArray, clock: VirtualClock, until_s: float) -> Any:
    """Compensated pressures of a run, (frames, tiles), as a driver's user would compute them."""
    parts = [Coefficients.from_words(tile.coefficient_words) for tile in array.tiles]
    columns = [np.array([getattr(c, name) for c in parts]) for name in ("a0", "b1", "b2", "c12")]
    scans = []
    while clock.now_ns() < EPOCH_NS + until_s * 1e9:
        scans.append(array.scan_frame())
    t_s = np.array([scan.convert_stop_ns[0] - EPOCH_NS for scan in scans]) * 1e-9
    kpa = compensate_kpa(
        [s.pressure_raw for s in scans], [s.temperature_raw for s in scans], *columns
    )
    return t_s, kpa


def test_a_load_shows_as_the_pressure_that_the_dome_of_the_serial_has() -> None:
    scene = make_scene(ground={"kind": "plate", "load_n": 40.0, "sway_m": 0.0})
    t_s, kpa = kpa_of(*switched_on(scene, lead_s=0.5), until_s=2.0)
    for tile, serial in enumerate(("T01", "T02", "T03", "T04")):
        dome = draw_dome(serial, 0)
        idle, loaded = kpa[t_s < 0.4, tile].mean(), kpa[t_s > 1.0, tile].mean()
        assert idle == pytest.approx(dome.seal_kpa, abs=0.15)
        lost = dome.stiffening * math.log(1 + 10.0 / dome.knee_n)
        assert loaded * (1 + dome.wall_per_kpa * (loaded - dome.seal_kpa)) * (
            1 - lost
        ) == pytest.approx(dome.seal_kpa, abs=0.2)
        assert loaded > idle + 4


def test_a_bare_reference_tile_reads_the_atmosphere_plus_the_head_and_no_load() -> None:
    scene = make_scene(
        TWO,
        ground={"kind": "plate", "load_n": 20.0, "sway_m": 0.0},
        emulation={"ambient_kpa": 99.3, "head_kpa": 8.0, "head_s": 1.5},
    )
    scene = moved_to(scene, 1, reference=True)
    t_s, kpa = kpa_of(*switched_on(scene, lead_s=0.5), until_s=2.5)
    idle, loaded, wet = kpa[t_s < 0.4], kpa[(t_s > 1.0) & (t_s < 1.4)], kpa[t_s > 1.6]
    assert loaded[:, 0].mean() > idle[:, 0].mean() + 4
    # Within a count, and through no dome: all of the head, where a dome lets 11 % through.
    assert idle[:, 1].mean() == pytest.approx(99.3, abs=0.13)
    assert loaded[:, 1].mean() == pytest.approx(99.3, abs=0.13)
    assert wet[:, 1].mean() == pytest.approx(107.3, abs=0.13)
    assert wet[:, 0].mean() - loaded[:, 0].mean() < 2.0


def test_a_bare_reference_tile_has_the_noise_and_the_temperature_of_a_chip() -> None:
    cold = {"noise_kpa": 0.165, "temperature_step_k": -4.0, "temperature_step_s": 1.0}
    scene = moved_to(make_scene(TWO, emulation=cold), 1, reference=True)
    _, array, clock = switched_on(scene)
    scans = []
    while clock.now_ns() < EPOCH_NS + 12_000_000_000:
        scans.append(array.scan_frame())
    t_s = np.array([scan.convert_stop_ns[1] - EPOCH_NS for scan in scans]) * 1e-9
    tadc = np.array([scan.temperature_raw[1] for scan in scans])
    # hardware.md 1.3: -5.35 counts per kelvin
    assert tadc[t_s > 10].mean() - tadc[t_s < 1].mean() == pytest.approx(4 * 5.35, abs=0.5)
    parts = Coefficients.from_words(array.tiles[1].coefficient_words)
    columns = (parts.a0, parts.b1, parts.b2, parts.c12)
    kpa = compensate_kpa([scan.pressure_raw[1] for scan in scans], tadc, *columns)
    # The gas in no bubble cools: only the chip's reported temperature is noisy (0.5 counts).
    assert kpa[t_s < 1].std() == pytest.approx(0.165, rel=0.15)
    assert kpa[t_s > 10].mean() == pytest.approx(kpa[t_s < 1].mean(), abs=0.05)


def test_what_replaces_a_reference_tile_is_bare_too() -> None:
    scene = moved_to(make_scene(TWO, emulation={"ambient_kpa": 89.9}), 1, reference=True)
    world, _, clock = switched_on(scene)
    with world.inject_fault("replaced", "T02"):
        pass
    spare = switched_on(moved_to(scene, 1, serial="T02.spare"))[1].tiles[1]
    bus = open_bus("emulated", world.i2c_adapter)
    tiles = identify_tiles(bus, scene.tile)
    assert tiles[1].coefficient_words == spare.coefficient_words
    timing = BusTiming(400_000, (3.0e-3, 3.0e-3), (0x70, 0x70))
    array = TileArray(
        bus, tiles, clock, schedule="simultaneous", timing=timing, broadcast_channels=64
    )
    parts = Coefficients.from_words(spare.coefficient_words)
    scan = [array.scan_frame() for _ in range(3)][-1]
    columns = (parts.a0, parts.b1, parts.b2, parts.c12)
    assert float(
        compensate_kpa(scan.pressure_raw[1], scan.temperature_raw[1], *columns)
    ) == pytest.approx(89.9, abs=0.13)


def test_sixty_four_tiles_on_eight_muxes_are_found() -> None:
    plugs = tuple((mux, channel) for mux in range(0x70, 0x78) for channel in range(8))
    found = identified(make_scene(plugs))
    assert len({tile.coefficient_words for tile in found}) == 64


# Truth


def at(*t_s: float) -> npt.NDArray[np.int64]:
    return np.array([EPOCH_NS + round(t * 1e9) for t in t_s], dtype=np.int64)


def test_truth_is_told_for_the_clocks_own_time_and_from_power_up() -> None:
    scene = make_scene(ground={"kind": "plate", "load_n": 40.0, "sway_m": 0.0})
    world, _, _ = switched_on(scene, lead_s=0.5)
    truth = world.compute_truth(at(0.0, 0.49, 0.65, 0.8, 9.0))
    np.testing.assert_allclose(truth.true_grf_n, [0, 0, 20, 40, 40], atol=1e-9)
    np.testing.assert_allclose(truth.true_force_n[-1], [10.0] * 4)
    np.testing.assert_array_equal(truth.true_plate_n, truth.true_grf_n)
    assert np.isnan(truth.true_angle_rad).all()


def test_without_load_there_is_no_centre_of_pressure() -> None:
    scene = make_scene(ground={"kind": "plate", "sway_m": 0.005})
    world, _, _ = switched_on(scene, lead_s=0.5)
    truth = world.compute_truth(at(0.0, 0.4, *np.linspace(1.0, 20.0, 200)))
    assert np.isnan(truth.true_cop_x_m[:2]).all()
    assert np.isnan(truth.true_cop_y_m[:2]).all()
    x_m = np.array([tile.x_m for tile in scene.tile])
    expected = truth.true_force_n[2:] @ x_m / truth.true_force_n[2:].sum(1)
    np.testing.assert_allclose(truth.true_cop_x_m[2:], expected, atol=1e-12)
    assert np.ptp(expected) > 0.005
    np.testing.assert_allclose(truth.true_cop_y_m[2:], 0.0, atol=1e-12)


def test_the_force_of_a_rolling_foot_is_the_vertical_sum() -> None:
    world, _, _ = switched_on(load_scene("rolling"), lead_s=0.0)
    truth = world.compute_truth(at(0.7, 1.0, 1.5, 2.0))
    np.testing.assert_allclose(truth.true_grf_n, 8.92, atol=1e-3)
    # Forces along the domes' axes are never less than what they bear vertically.
    assert (truth.true_force_n.sum(axis=1) >= truth.true_grf_n - 1e-9).all()
    assert (np.diff(truth.true_cop_x_m) > 0).all()
    assert (np.diff(truth.true_angle_rad) > 0).all()


@pytest.mark.parametrize("protocol", [1, 2])
@pytest.mark.parametrize(("sign", "ratio"), [(1, 0.1), (-1, 0.1), (1, 1.0), (-1, 0.5)])
def test_a_reader_of_the_servo_gets_the_true_angle_back(
    sign: int, ratio: float, protocol: int
) -> None:
    scene = load_scene("rolling")
    assert scene.servo is not None
    keys = scene.servo.model_copy(
        update={"sign": sign, "ratio": ratio, "zero_counts": 1000, "protocol": protocol}
    )
    world, _, _ = switched_on(scene, lead_s=0.0)
    line_clock = VirtualClock(EPOCH_NS + 1_000_000_000)
    with world.open_servo(keys, line_clock) as emulated:
        servo = open_servo(
            emulated.port,
            baudrate=keys.baudrate,
            clock=line_clock,
            servo_id=keys.id,
            model=keys.model,
            protocol=keys.protocol,
        )
        with contextlib.closing(servo):
            assert servo.read_identity().model_number == {1: 29, 2: 30}[protocol]  # MX-28
            reading = servo.read_position()
    # docs/scenes.md: angle = sign (counts - zero) 2 pi / counts per turn * ratio
    angle_rad = sign * (reading.counts - 1000) * 2 * math.pi / 4096 * ratio
    true_rad = world.compute_truth(np.array([reading.t_mono_ns])).true_angle_rad[0]
    assert angle_rad == pytest.approx(true_rad, abs=0.51 * 2 * math.pi / 4096 * ratio + 1e-4)
    assert abs(true_rad) > 0.01


# The mill


def test_only_the_mill_has_a_reference_force() -> None:
    assert switched_on(make_scene())[0].indenter is None
    assert switched_on(make_scene(ground={"kind": "indentation"}))[0].indenter is not None


def test_the_mills_notes_name_tile_and_phase() -> None:
    world, _, _ = switched_on(make_scene(TWO, ground={"kind": "indentation"}), lead_s=1.0)
    mill = world.indenter
    assert mill is not None
    notes = mill.get_operator_notes(at(0.5, 1.1, 2.0, 6.0, 10_000.0))
    assert notes["pressed_tile"].tolist() == [None, "T01", "T01", "T01", None]
    assert notes["phase"].tolist() == ["rest", "rest", "load", "unload", "soak"]


@pytest.mark.slow
def test_the_soak_is_warmer_at_its_end() -> None:
    keys = {"kind": "indentation", "stroke_s": 0.1, "repeats": 2, "soak_k": 4.0}
    scene = make_scene(ONE, ground=keys)
    world, array, clock = switched_on(scene, lead_s=0.5)
    end_s = world.ground.duration_s
    assert end_s is not None
    t_s, kpa = kpa_of(world, array, clock, until_s=end_s)
    before, after = kpa[(t_s > end_s - 30) & (t_s < end_s - 26)], kpa[t_s > end_s - 2]
    # hardware.md 9: about 0.30 kPa/K, by the end nearly all of it
    assert (after.mean() - before.mean()) / 4.0 == pytest.approx(0.30, abs=0.04)


# When the scene's time begins


def test_until_it_begins_all_is_as_at_its_first_instant() -> None:
    scene = make_scene(ONE, ground={"kind": "plate", "load_n": 20.0, "sway_m": 0.0})
    world, array, clock = switched_on(scene, lead_s=0.5, begins_now=False)
    idle = {scan.pressure_raw[0] for scan in (array.scan_frame() for _ in range(500))}
    assert clock.now_ns() > EPOCH_NS + 1_000_000_000, "the load would have come long ago"
    assert len(idle) == 1
    assert world.compute_truth(at(0.0, 100.0)).true_grf_n.tolist() == [0.0, 0.0]
    begin_ns = clock.now_ns()
    world.begin_scene_time()
    assert world.epoch_ns == begin_ns
    loaded = {scan.pressure_raw[0] for scan in (array.scan_frame() for _ in range(500))}
    assert min(loaded) < min(idle) - 20  # it falls as pressure rises
    t_ns = np.array([begin_ns, begin_ns + 1_000_000_000])
    np.testing.assert_allclose(world.compute_truth(t_ns).true_grf_n, [0.0, 20.0], atol=1e-9)


def test_faults_wait_for_the_scene_to_begin() -> None:
    fault = {"kind": "no_answer", "tile": "T01", "t_s": 1e-4, "duration_s": 0.5}
    world, array, clock = switched_on(make_scene(TWO, fault=[fault]), begins_now=False)
    assert array.scan_frame().tile_flags == [0, 0]
    world.begin_scene_time()
    begin_ns = clock.now_ns()
    assert array.scan_frame().tile_flags == [1, 0]
    clock.sleep_until_ns(begin_ns + 3_000_000_000)
    assert array.scan_frame().tile_flags == [1, 0], (
        "it is looked for, and believed with the next frame"
    )
    assert array.scan_frame().tile_flags == [0, 0]


def test_a_tile_that_fails_from_the_first_instant_on_is_not_found() -> None:
    fault = {"kind": "no_answer", "tile": "T02", "t_s": 0.0, "duration_s": 0.5}
    with pytest.raises(TileSetupError, match="T02"):
        switched_on(make_scene(TWO, fault=[fault]), begins_now=False)


def test_the_bus_is_as_fast_as_the_core_clock_lets_it() -> None:
    # hardware.md 3.2: 250 kHz where 400 was asked for, 5/8
    world, _, clock = switched_on(make_scene(ONE, emulation={"scl_part": 0.625}))
    begin_ns = clock.now_ns()
    world.i2c_adapter.i2c_rdwr(i2c_msg.write(0x70, [1]))
    assert clock.now_ns() - begin_ns == 20 * 4_000


def test_a_replaced_tile_is_another_part_for_ever() -> None:
    scene = make_scene(TWO)
    world, array, _ = switched_on(scene)
    bus = I2cBus(world.i2c_adapter, "emulated")
    with world.inject_fault("replaced", "T02"):
        pass
    found = [tile.coefficient_words for tile in identify_tiles(bus, scene.tile)]
    assert found[0] == array.tiles[0].coefficient_words
    assert found[1] == draw_chip("T02.spare", 0).coefficients.to_words()
    assert found[1] != array.tiles[1].coefficient_words


def test_a_tile_pressed_over_its_range_shows_no_pressure_of_its_range() -> None:
    world, array, _ = switched_on(make_scene(ONE))
    parts = Coefficients.from_words(array.tiles[0].coefficient_words)

    def kpa() -> float:
        scan = array.scan_frame()
        (padc,), (tadc,) = scan.pressure_raw, scan.temperature_raw
        return float(compensate_kpa(padc, tadc, parts.a0, parts.b1, parts.b2, parts.c12))

    assert 95 < kpa() < 105
    with world.inject_fault("over_range", "T01"):
        assert not 50 <= kpa() <= 115
    assert 95 < kpa() < 105


def test_a_punctured_dome_loses_its_gas_and_its_neighbour_does_not() -> None:
    fault = {"kind": "puncture", "tile": "T01", "t_s": 1.0, "duration_s": 60.0, "leak_s": 0.2}
    loads = {"ground": {"kind": "plate", "load_n": 20.0, "sway_m": 0.0}, "fault": [fault]}
    scene = make_scene(TWO, **loads)
    world, array, clock = switched_on(scene, lead_s=0.2)

    def kpa() -> list[float]:
        scan = array.scan_frame()
        return [
            float(compensate_kpa(padc, tadc, c.a0, c.b1, c.b2, c.c12))
            for padc, tadc, tile in zip(
                scan.pressure_raw, scan.temperature_raw, array.tiles, strict=True
            )
            for c in [Coefficients.from_words(tile.coefficient_words)]
        ]

    clock.sleep_until_ns(EPOCH_NS + 900_000_000)
    before = kpa()
    while clock.now_ns() < EPOCH_NS + 3_000_000_000:
        array.scan_frame()
    after = kpa()
    assert before[0] > after[0] + 1.0
    assert after[1] == pytest.approx(before[1], abs=0.5)
    assert after[0] == pytest.approx(
        world._make_surroundings(f"{scene.name}/0").ambient_kpa, abs=0.3
    )
