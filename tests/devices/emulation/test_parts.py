"""What a serial stands for: one part with its coefficients, noise and conversion time, for ever."""

from __future__ import annotations

import numpy as np
import pytest
from smbus2 import i2c_msg

from devices.buses.i2c import I2cBus
from devices.chips.mpl115a2 import Coefficients, compute_padc
from devices.emulation.parts import draw_chip, draw_dome
from devices.scene.scene_file import Scene
from tests.builders.scenes import make_scene
from tests.devices.emulation.worlds import TWO, counts, identified, moved_to, switched_on
from tests.devices.rigs import ONE, Plugs


def test_a_serial_is_the_same_part_for_ever() -> None:
    # No truth of nature but a promise: calibrations are kept by serial, so whoever changes how
    # parts are drawn makes all of them wrong.
    first, second = draw_chip("T01", 0), draw_chip("T02", 0)
    assert first.coefficients.to_words() == (0x3E02, 0xBE5E, 0xC95E, 0x2E98)
    assert second.coefficients.to_words() == (0x3FFF, 0xB12E, 0xC6E7, 0x2EC4)
    assert (first.conversion_ns, second.conversion_ns) == (1_977_258, 1_505_762)
    assert draw_dome("T01", 0).seal_kpa == pytest.approx(102.425038, abs=1e-6)
    assert draw_dome("T02", 0).loop_n == pytest.approx(0.382606, abs=1e-6)


SERIALS = [f"T{i:02d}" for i in range(1, 101)]


def test_drawn_chips_are_such_as_are_known() -> None:
    for serial in SERIALS:
        chip = draw_chip(serial, 0)
        c = chip.coefficients
        assert c.find_implausibility() == ""
        # hardware.md 1.6: what brackets the three known parts
        assert 1699 < c.a0 < 2201
        assert -2.501 < c.b1 < -1.899
        assert -1.001 < c.b2 < -0.849
        assert 0.000649 < c.c12 < 0.000881
        assert 250 <= float(compute_padc(100.0, 500, c)) <= 500
        # hardware.md 1.4, 1.6: 1.4 to 2.0 ms, never above 3
        assert 1_400_000 <= chip.conversion_ns <= 2_000_000
        # hardware.md 1.3: two published scales, 472 and 498 at 25 degC
        assert 472 <= chip.tadc_at_25_degc <= 498
        assert Coefficients.from_words(c.to_words()) == c, "it is what its registers hold"


def test_no_two_serials_are_alike() -> None:
    assert len({draw_chip(serial, 0) for serial in SERIALS}) == len(SERIALS)
    assert len({draw_dome(serial, 0) for serial in SERIALS}) == len(SERIALS)
    assert len({draw_chip(serial, 0).conversion_ns for serial in SERIALS}) == len(SERIALS)


def test_another_shelf_has_other_parts() -> None:
    assert draw_chip("T01", 1) != draw_chip("T01", 0)
    assert draw_dome("T01", 1) != draw_dome("T01", 0)
    assert draw_chip("T01", 1) == draw_chip("T01", 1)


def test_the_coefficients_on_the_bus_are_those_of_the_serial() -> None:
    plugs: Plugs = ((0x77, 7), (0x70, 3), (0x73, 0))
    found = identified(make_scene(plugs))
    assert [tile.coefficient_words for tile in found] == [
        draw_chip(serial, 0).coefficients.to_words() for serial in ("T01", "T02", "T03")
    ]


def test_a_tile_is_the_same_in_every_scene_and_session() -> None:
    bench = make_scene(TWO, name="bench")
    field = make_scene(((0x70, 5), (0x74, 2), (0x70, 6)), name="field")
    field = moved_to(moved_to(field, 1, serial="T02"), 0, serial="T09")
    assert identified(bench)[1].coefficient_words == identified(field, seed=3)[1].coefficient_words
    # Without noise an idle tile reads the same pressure: chip and dome are the same.
    idle_bench, idle_field = counts(bench)[:, 0, 1], counts(field, seed=3)[:, 0, 1]
    assert set(idle_bench.tolist()) == set(idle_field.tolist())
    assert len(set(idle_bench.tolist())) == 1


def test_a_seed_changes_the_noise_and_not_the_parts() -> None:
    scene = make_scene(TWO, emulation={"noise_kpa": 0.165})
    first, again, other = counts(scene), counts(scene, seed=0), counts(scene, seed=1)
    np.testing.assert_array_equal(first, again)
    assert (first[:, 0] != other[:, 0]).mean() > 0.3
    np.testing.assert_allclose(first[:, 0].mean(0), other[:, 0].mean(0), atol=2.0)
    assert identified(scene) == identified(scene, seed=1)
    assert [t.coefficient_words for t in identified(scene)] != [
        t.coefficient_words for t in identified(scene, parts_seed=1)
    ]


def test_a_tile_on_the_bench_does_not_see_the_noise_of_the_field() -> None:
    noisy = {"noise_kpa": 0.165}
    bench = counts(make_scene(ONE, name="bench", emulation=noisy), 200)[:, 0, 0]
    field = counts(make_scene(ONE, name="field", emulation=noisy), 200)[:, 0, 0]
    assert abs(np.corrcoef(bench, field)[0, 1]) < 0.3


def test_tiles_have_noise_of_their_own() -> None:
    read = counts(make_scene(TWO, emulation={"noise_kpa": 0.165}), 200)[:, 0]
    assert abs(np.corrcoef(read[:, 0], read[:, 1])[0, 1]) < 0.3


# Conversion times, as a driver could measure them (hardware.md 1.4, self-test)


def conversion_us(scene: Scene, tile: int) -> float:
    """From the STOP of the first CONVERT to the first reading that is not zero, give or take."""
    world, _, clock = switched_on(scene)
    plug, bus = scene.tile[tile], I2cBus(world.i2c_adapter, "emulated")
    bus.transfer(i2c_msg.write(plug.mux, [1 << plug.channel]))
    bus.transfer(i2c_msg.write(0x60, [0x12, 0x00]))
    stop_ns = clock.now_ns()
    words = i2c_msg.read(0x60, 4)
    while bytes(words) == bytes(4):
        asked_ns = clock.now_ns()
        bus.transfer(i2c_msg.write(0x60, [0x00]), words)
        assert asked_ns - stop_ns < 5_000_000
    return (asked_ns - stop_ns) / 1_000


def test_every_part_has_a_conversion_time_of_its_own() -> None:
    scene = make_scene(TWO)
    for tile, serial in enumerate(("T01", "T02")):
        drawn_us = draw_chip(serial, 0).conversion_ns / 1_000
        assert conversion_us(scene, tile) == pytest.approx(drawn_us, abs=170)
    assert conversion_us(scene, 0) - conversion_us(scene, 1) > 300


def test_a_scene_can_give_all_parts_the_same_conversion_time() -> None:
    scene = make_scene(TWO, array={"conversion_ms": 2.5})
    assert [conversion_us(scene, tile) for tile in (0, 1)] == pytest.approx([2500] * 2, abs=170)
