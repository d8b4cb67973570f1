"""An emulated foot: its parts, its pressure on the bus, and the truth of its ground."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest

from devices.array.tile import Scan
from devices.array.tile_array import TileArray
from devices.buses.i2c import open_bus
from devices.chips.dynamixel.servo_setup import open_servo
from devices.chips.pressure_chips import Compensation
from devices.clock import VirtualClock
from devices.emulation.chips.mpl115a2 import draw_chip
from devices.emulation.parts import draw_dome
from devices.errors import TileSetupError
from devices.scene.scene_file import load_scene
from tests.builders.scenes import make_scene
from tests.devices.emulation.worlds import EPOCH_NS, TWO, identified, moved_to, switched_on
from tests.devices.feet import array_of
from tests.devices.rigs import ONE

Floats = npt.NDArray[np.float64]

# Pressure, end to end


def compensate(array: TileArray, scans: Sequence[Scan]) -> Floats:
    """Return pressures of scans, (frames, tiles), as a user of the driver computes them."""
    return Compensation(array.tiles).law.compute_kpa(
        [s.pressure_raw for s in scans], [s.temperature_raw for s in scans]
    )


def record(
    array: TileArray, clock: VirtualClock, until_s: float
) -> tuple[Floats, Floats, list[Scan]]:
    """Return times, pressures and scans up to an instant of the scene."""
    scans = []
    while clock.now_ns() < EPOCH_NS + until_s * 1e9:
        scans.append(array.scan_frame())
    t_s = np.array([scan.convert_stop_ns[0] - EPOCH_NS for scan in scans]) * 1e-9
    return t_s, compensate(array, scans), scans


def test_a_load_shows_as_the_pressure_of_the_dome_of_the_serial() -> None:
    scene = make_scene(ground={"kind": "plate", "load_n": 40.0, "sway_m": 0.0})
    _, array, clock = switched_on(scene, lead_s=0.3)
    t_s, kpa, _ = record(array, clock, until_s=1.2)
    for tile, serial in enumerate(("T01", "T02", "T03", "T04")):
        dome = draw_dome(serial, 0)
        idle, loaded = kpa[t_s < 0.25, tile].mean(), kpa[t_s > 0.8, tile].mean()
        assert idle == pytest.approx(dome.seal_kpa, abs=0.15)
        lost = dome.stiffening * math.log(1 + 10.0 / dome.knee_n)
        assert loaded * (1 + dome.wall_per_kpa * (loaded - dome.seal_kpa)) * (
            1 - lost
        ) == pytest.approx(dome.seal_kpa, abs=0.2)
        assert loaded > idle + 4


def test_a_reference_tile_reads_atmosphere_head_and_temperature_and_no_load() -> None:
    scene = make_scene(
        TWO,
        ground={"kind": "plate", "load_n": 20.0, "sway_m": 0.0},
        emulation={
            **{"ambient_kpa": 99.3, "head_kpa": 8.0, "head_s": 1.5, "noise_kpa": 0.165},
            **{"temperature_step_k": -4.0, "temperature_step_s": 2.0},
        },
    )
    _, array, clock = switched_on(moved_to(scene, 1, reference=True), lead_s=0.5)
    t_s, kpa, scans = record(array, clock, until_s=10.0)
    idle, loaded = kpa[t_s < 0.4], kpa[(t_s > 1.0) & (t_s < 1.4)]
    wet, cold = kpa[(t_s > 1.6) & (t_s < 2.0)], kpa[t_s > 9]
    assert loaded[:, 0].mean() > idle[:, 0].mean() + 4
    # A reference tile reads all of the head, a dome 11 %.
    assert idle[:, 1].mean() == pytest.approx(99.3, abs=0.13)
    assert loaded[:, 1].mean() == pytest.approx(99.3, abs=0.13)
    assert wet[:, 1].mean() == pytest.approx(107.3, abs=0.13)
    assert wet[:, 0].mean() - loaded[:, 0].mean() < 2.0
    assert cold[:, 1].std() == pytest.approx(0.165, rel=0.15)
    assert cold[:, 1].mean() == pytest.approx(wet[:, 1].mean(), abs=0.05), "no gas that cools"
    # hardware.md 1.3: -5.35 counts per kelvin
    tadc = np.array([scan.temperature_raw[1] for scan in scans])
    assert tadc[t_s > 9].mean() - tadc[t_s < 1.9].mean() == pytest.approx(4 * 5.35, abs=0.5)


def test_a_replaced_part_is_another_one_of_the_same_kind() -> None:
    scene = moved_to(make_scene(TWO, emulation={"ambient_kpa": 89.9}), 1, reference=True)
    world, before, clock = switched_on(scene)
    with world.inject_fault("replaced", "T02"):
        pass
    after = array_of(open_bus("emulated", world.i2c_adapter), scene.tile, clock, wait_s=3e-3)
    words = [tile.registers for tile in after.tiles]
    assert words[0] == before.tiles[0].registers
    spare = draw_chip("T02.spare", 0).coefficients.to_words()
    assert words[1] == spare != before.tiles[1].registers
    scans = [after.scan_frame() for _ in range(3)]
    assert compensate(after, scans)[-1, 1] == pytest.approx(89.9, abs=0.13)


def test_sixty_four_tiles_on_eight_muxes_are_found() -> None:
    plugs = tuple((mux, channel) for mux in range(0x70, 0x78) for channel in range(8))
    found = identified(make_scene(plugs))
    assert len({tile.registers for tile in found}) == 64


# Truth


def at(*t_s: float) -> npt.NDArray[np.int64]:
    return np.array([EPOCH_NS + round(t * 1e9) for t in t_s], dtype=np.int64)


def test_the_truth_is_that_of_the_instants_of_the_clock() -> None:
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
def test_a_reader_of_the_servo_gets_the_true_angle(sign: int, ratio: float, protocol: int) -> None:
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


# Indenter


def test_only_an_indenter_has_notes_of_tile_and_phase() -> None:
    assert switched_on(make_scene())[0].indenter is None
    world, _, _ = switched_on(make_scene(TWO, ground={"kind": "indentation"}), lead_s=1.0)
    indenter = world.indenter
    assert indenter is not None
    notes = indenter.get_operator_notes(at(0.5, 1.1, 2.0, 6.0, 10_000.0))
    assert notes["pressed_tile"].tolist() == [None, "T01", "T01", "T01", None]
    assert notes["phase"].tolist() == ["rest", "rest", "load", "unload", "soak"]


# Beginning of the scene's time


def test_a_scene_stays_at_its_first_instant_until_it_begins() -> None:
    scene = make_scene(ONE, ground={"kind": "plate", "load_n": 20.0, "sway_m": 0.0})
    world, array, clock = switched_on(scene, lead_s=0.5, begins_now=False)
    idle = {scan.pressure_raw[0] for scan in (array.scan_frame() for _ in range(500))}
    assert clock.now_ns() > EPOCH_NS + 1_000_000_000, "later than the load"
    assert len(idle) == 1
    assert world.compute_truth(at(0.0, 100.0)).true_grf_n.tolist() == [0.0, 0.0]
    begin_ns = clock.now_ns()
    world.begin_scene_time()
    assert world.epoch_ns == begin_ns
    loaded = {scan.pressure_raw[0] for scan in (array.scan_frame() for _ in range(500))}
    assert min(loaded) < min(idle) - 20  # it falls as pressure rises
    t_ns = np.array([begin_ns, begin_ns + 1_000_000_000])
    np.testing.assert_allclose(world.compute_truth(t_ns).true_grf_n, [0.0, 20.0], atol=1e-9)


def test_a_fault_begins_with_the_scene_unless_it_is_there_from_the_first_instant_on() -> None:
    fault = {"kind": "no_answer", "tile": "T01", "t_s": 1e-4, "duration_s": 0.5}
    world, array, clock = switched_on(make_scene(TWO, fault=[fault]), begins_now=False)
    assert array.scan_frame().tile_flags == [0, 0]
    world.begin_scene_time()
    begin_ns = clock.now_ns()
    assert array.scan_frame().tile_flags == [1, 0]
    clock.sleep_until_ns(begin_ns + 3_000_000_000)
    assert array.scan_frame().tile_flags == [1, 0], "it is identified before it is believed"
    assert array.scan_frame().tile_flags == [0, 0]
    with pytest.raises(TileSetupError, match="T01"):
        switched_on(make_scene(TWO, fault=[fault | {"t_s": 0.0}]), begins_now=False)


def test_a_punctured_dome_loses_its_gas_and_its_neighbour_does_not() -> None:
    fault = {"kind": "puncture", "tile": "T01", "t_s": 1.0, "duration_s": 60.0, "leak_s": 0.2}
    ground = {"kind": "plate", "load_n": 20.0, "sway_m": 0.0}
    world, array, clock = switched_on(make_scene(TWO, ground=ground, fault=[fault]), lead_s=0.2)
    t_s, kpa, _ = record(array, clock, until_s=3.0)
    before, after = kpa[(t_s > 0.8) & (t_s < 1.0)].mean(axis=0), kpa[-1]
    assert before[0] > after[0] + 1.0
    assert after[1] == pytest.approx(before[1], abs=0.5)
    assert after[0] == pytest.approx(world._make_surroundings("test/0").ambient_kpa, abs=0.3)
