"""Scene files: built-in scenes, and the defaults of missing keys."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.scene.emulation_sections import MudGround, PoppyGround
from devices.scene.scene_file import list_builtin_scenes, load_scene
from tests.devices.scene.texts import refused, scene, tile

# Built-in scenes


@pytest.mark.parametrize("name", list_builtin_scenes())
def test_a_built_in_scene_loads_under_its_own_name(name: str) -> None:
    loaded = load_scene(name)
    assert loaded.name == name
    assert [t.serial for t in loaded.tile] == [f"T{i + 1:02d}" for i in range(len(loaded.tile))]
    assert not loaded.fault


def test_built_in_scenes_have_the_facts_of_the_paper() -> None:
    assert {"standing", "indentation", "rolling", "insole"} <= set(list_builtin_scenes())
    standing = load_scene("standing")
    assert len(standing.tile) == 4
    assert (standing.array.conversion_ms, standing.array.wait_ms) == (1.6, None)
    assert standing.array.scl_hz == 400_000
    indentation = load_scene("indentation")
    assert indentation.emulation.repeatability == 0.03
    assert indentation.ground.kind == "indentation"
    # data/README.md: left foot, in mm; our x is its y, our y its -x
    cells_mm = [(0, -100), (-25, -50), (25, -50), (-25, 0), (25, 0), (-25, 50), (25, 50), (0, 100)]
    places = [(t.x_m, t.y_m) for t in load_scene("insole").tile]
    assert places == [(y / 1000, -x / 1000) for x, y in cells_mm]


def test_rolling_and_hopping_feet_are_an_arc_of_150_mm() -> None:
    rolling = load_scene("rolling")
    assert len(rolling.tile) == 4
    for t in rolling.tile:
        assert math.hypot(t.x_m, t.z_m) == pytest.approx(0.150, abs=1e-6)
    assert rolling.servo is not None
    assert rolling.servo.ankle_travel_m_per_rad == 0.150
    for name, references in (("poppy", []), ("mud", [True])):
        hopping = load_scene(name)
        assert hopping.tile[:4] == rolling.tile
        assert [tile.reference for tile in hopping.tile[4:]] == references
        # hardware.md 0: 909 g; docs/scenes.md: a 10 cm drop, on wet ground about 5 cm deep
        assert isinstance(hopping.ground, PoppyGround | MudGround)
        assert (hopping.ground.mass_kg, hopping.ground.drop_m) == (0.909, 0.10)


# Scene files


def test_the_temperature_step_of_mud_is_that_of_its_ground() -> None:
    text = refused(sections="[ground]\nkind = 'mud'\n[emulation]\ntemperature_step_k = -4.0")
    assert "ground.temperature_step_k" in text


def test_a_scene_file_is_read_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "my scene.toml"
    path.write_text('name = "mine"\n' + tile(), encoding="utf-8")
    assert load_scene(str(path)).name == "mine"


def test_missing_keys_have_the_defaults_of_the_design() -> None:
    bare = scene()
    assert bare.rate_hz == 0
    assert bare.calibration == "emulated-rig"
    assert bare.array.bus == "emulated"
    assert bare.array.scl_hz == 400_000
    assert bare.array.conversion_ms is None
    assert bare.array.schedule == "auto"
    assert bare.array.wait_ms is None, "measured"
    assert bare.array.temperature_every == 1
    assert bare.array.broadcast_channels == 8  # hardware.md 2: 8 channels want 10 kOhm
    assert bare.emulation.scl_part == 1.0
    assert bare.servo is None
    assert bare.ground.kind == "none"
    assert (bare.emulation.noise_kpa, bare.emulation.correlated_ms) == (0.165, 0)
    assert bare.emulation.repeatability == 0
    assert (bare.emulation.gas, bare.emulation.rubber, bare.emulation.hysteresis) == (True,) * 3
    assert bare.emulation.clip_kpa == 0
    assert bare.fault == ()


def test_a_rate_is_an_integer_or_as_slow_as_a_stream_can_hold() -> None:
    assert scene("rate_hz = 100").rate_hz == 100.0
    assert scene("rate_hz = 0.001").rate_hz == 0.001


def test_a_fault_names_a_tile_and_a_time() -> None:
    faulty = scene(
        sections='[[fault]]\nkind = "stale"\ntile = "T02"\nt_s = 3\nduration_s = 0.5'
    ).fault[0]
    assert (faulty.kind, faulty.tile, faulty.t_s, faulty.duration_s) == ("stale", "T02", 3.0, 0.5)


@given(
    plugs=st.lists(
        st.tuples(st.integers(0x70, 0x77), st.integers(0, 7)), unique=True, min_size=1, max_size=64
    )
)
def test_every_channel_of_every_mux_can_hold_a_tile(plugs: list[tuple[int, int]]) -> None:
    tiles = "".join(
        tile(f"S{i}", mux=hex(mux), channel=str(channel)) for i, (mux, channel) in enumerate(plugs)
    )
    assert [(t.mux, t.channel) for t in scene(tiles=tiles).tile] == plugs


def test_a_reference_force_needs_its_scale_and_nothing_else() -> None:
    reference = scene(sections="[reference]\nzero_v = 1.6\nn_per_v = -12").reference
    assert reference is not None
    assert (reference.zero_v, reference.n_per_v) == (1.6, -12.0)
    assert (reference.port, reference.channel, reference.vref_v) == ("emulated", 0, 3.3)
    assert scene().reference is None


def test_recovery_is_by_the_pins_of_a_raspberry_pi() -> None:
    recovery = scene(sections="[recovery]").recovery
    assert recovery is not None
    assert recovery.gpiochip == "/dev/gpiochip0"
    assert (recovery.scl_line, recovery.sda_line, recovery.reset_line) == (3, 2, None)
    assert recovery.i2c_function == "a0"
    assert scene().recovery is None


def test_a_scene_cannot_be_changed_once_it_is_read() -> None:
    with pytest.raises(ValueError, match="frozen"):
        scene().rate_hz = 3.0
