"""Scene files: built-in scenes, the defaults of missing keys, and what is refused."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from devices.errors import SceneError
from devices.scene.emulation_sections import (
    EmulationSection,
    FaultKind,
    FaultSection,
    GroundSection,
    MudGround,
    PoppyGround,
    ServoFault,
)
from devices.scene.hardware_sections import (
    ArraySection,
    RecoverySection,
    ReferenceSection,
    ServoSection,
    SyncSection,
    TileSection,
)
from devices.scene.scene_file import (
    Scene,
    list_builtin_scenes,
    load_scene,
    parse_scene,
    replace_chips,
)

TILE = """
[[tile]]
serial = "{serial}"
mux = {mux}
channel = {channel}
x_m = {x_m}
y_m = 0
z_m = -0.15
"""


def tile(
    serial: str = "T01", mux: str = "0x70", channel: str = "0", x_m: str = "0.01", more: str = ""
) -> str:
    return TILE.format(serial=serial, mux=mux, channel=channel, x_m=x_m) + more


def scene(head: str = "", tiles: str | None = None, sections: str = "") -> Scene:
    tiles = tile() + tile("T02", channel="1") if tiles is None else tiles
    return parse_scene(f'name = "x"\n{head}\n{tiles}\n{sections}', where="my.toml")


def refused(head: str = "", tiles: str | None = None, sections: str = "") -> str:
    with pytest.raises(SceneError) as caught:
        scene(head, tiles, sections)
    assert caught.value.exit_code == 2
    assert caught.value.where == "my.toml"
    assert caught.value.__cause__ is not None
    return str(caught.value)


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
    bare = scene(sections="[recovery]")  # tests/test_docs.py has those that docs/scenes.md lists
    assert bare.array.conversion_ms is bare.array.wait_ms is None  # drawn, and measured
    assert bare.emulation.gas is bare.emulation.rubber is bare.emulation.hysteresis is True
    assert bare.recovery is not None
    assert (bare.recovery.reset_line, bare.servo, scene().recovery) == (None, None, None)
    assert (bare.rate_hz, bare.calibration) == (0, "emulated-rig")
    assert (bare.ground.kind, bare.fault) == ("none", ())


def test_a_rate_is_an_integer_or_as_slow_as_a_stream_can_hold() -> None:
    assert scene("rate_hz = 100").rate_hz == 100.0
    assert scene("rate_hz = 0.001").rate_hz == 0.001


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


def test_a_scene_cannot_be_changed_once_it_is_read() -> None:
    with pytest.raises(ValueError, match="frozen"):
        scene().rate_hz = 3.0


# Refused scenes, each with its wrong key

REFERENCE = "[reference]\nzero_v = 1.65\nn_per_v = 30.0\n"
NEEDED = {
    "reference.": {"zero_v": "1.65", "n_per_v": "30.0"},
    "fault.0.": {"kind": "'stale'", "tile": "'T01'", "t_s": "0", "duration_s": "1"},
    "tile.2.": {"serial": "'T03'", "mux": "0x70", "channel": "5"}
    | dict.fromkeys(("x_m", "y_m", "z_m"), "0.01"),
}
SECTIONS: dict[str, tuple[type[BaseModel], str]] = {
    "": (Scene, ""),
    "array.": (ArraySection, "[array]"),
    "servo.": (ServoSection, "[servo]"),
    "reference.": (ReferenceSection, "[reference]"),
    "recovery.": (RecoverySection, "[recovery]"),
    "sync.": (SyncSection, "[sync]"),
    "emulation.": (EmulationSection, "[emulation]"),
    "fault.0.": (FaultSection, "[[fault]]"),
    "tile.2.": (TileSection, "[[tile]]"),
    **{
        f"ground.{kind}.": (ground, f"[ground]\nkind = '{kind}'")
        for ground in get_args(get_args(GroundSection)[0])
        for kind in get_args(ground.model_fields["kind"].annotation)
    },
}
VALUES = {bool: ("true",), int: ("3",), float: ("1.5", "nan", "inf", "-inf"), str: ("'1.6'",)}
"""Values of each TOML type."""


def list_types(hint: Any) -> set[Any]:
    """Return the types of a key's values; none for a literal, which accepts no value of VALUES."""
    if get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    inner = () if get_origin(hint) is Literal else get_args(hint) or (hint,)
    return set().union(*({each} if each is hint else list_types(each) for each in inner))


def refused_key(section: str, key: str, value: str) -> str:
    """Return the refusal of a section that is complete but for this key."""
    lines = NEEDED.get(section, {}) | {key: value}
    text = "\n".join(f"{name} = {content}" for name, content in lines.items())
    _, head = SECTIONS[section]
    return refused(sections=f"{head}\n{text}") if head else refused(text)


@pytest.mark.parametrize("section", SECTIONS)
def test_an_unknown_key_is_named_with_its_section(section: str) -> None:
    text = refused_key(section, "surprise", "1")
    assert text == f"my.toml: unknown key '{section}surprise'. Check its spelling, or remove it"


@pytest.mark.parametrize("section", SECTIONS)
def test_a_wrong_type_or_no_finite_number_is_refused_and_not_converted(section: str) -> None:
    model, _ = SECTIONS[section]
    for name, field in model.model_fields.items():
        types = list_types(field.annotation) - {NoneType}
        if not types <= set(VALUES) or (section, name) == ("", "name"):
            continue
        if section.startswith("ground.") and name == "kind":
            continue
        accepted = types | ({int} if float in types else set())
        wrong = [v for kind, values in VALUES.items() if kind not in accepted for v in values]
        for value in (*wrong, *VALUES[float][1:]):
            text = refused_key(section, name, value)
            assert f"{section}{name} = " in text, value
            assert re.search(r"[Ii]nput should be|is no number", text), "it names the type"


@pytest.mark.parametrize(
    ("head", "sections", "key"),
    [
        ("models = 'static'", "", "models"),
        ("models = [1]", "", "models.0"),
        ("rate_hz = -1", "", "rate_hz"),
        ("rate_hz = 1e-4", "", "rate_hz = 0.0001"),
        ("", "[array]\nscl_hz = 0", "array.scl_hz"),
        ("", "[array]\nscl_hz = 400", "array.scl_hz"),  # kHz
        ("", "[array]\nscl_hz = 400000000", "array.scl_hz"),
        ("", "[array]\nwait_ms = 0", "array.wait_ms"),
        ("", "[array]\nconversion_ms = -1.6", "array.conversion_ms"),
        ("", "[array]\ntemperature_every = 0", "array.temperature_every"),
        ("", "[array]\nbroadcast_channels = 0", "array.broadcast_channels"),
        ("", "[array]\nbroadcast_channels = 65", "array.broadcast_channels"),
        ("", "[servo]\nrate_hz = 0", "servo.rate_hz"),
        # The angle would be constant, and the emulated servo would divide by it.
        ("", "[servo]\nratio = 0", "servo.ratio = 0"),
        ("", "[servo]\nratio = -0.0", "servo.ratio = -0"),
        ("", "[servo]\nid = 253", "id = 253: 253 is no servo id of protocol 2; expected 0 to 252"),
        (
            "",
            "[servo]\nprotocol = 1\nid = 254",
            "id = 254: 254 is no servo id of protocol 1; expected 0 to 253",
        ),
        ("", "[ground]\nkind = 'plate'\nload_n = -3", "load_n"),
        ("", "[ground]\nkind = 'indentation'\nrepeats = 1", "repeats"),
        ("", "[ground]\nkind = 'poppy'\ndrop_m = 10", "drop_m"),  # cm
        ("", "[ground]\nkind = 'poppy'\nmass_kg = 909", "mass_kg"),  # g
        ("", "[ground]\nkind = 'poppy'\ndome_share = 80", "dome_share"),  # %
        ("", "[ground]\nkind = 'mud'\nhead_kpa_per_m = 1.65", "head_kpa_per_m"),  # per 0.1 m
        ("", "[emulation]\nnoise_kpa = -0.1", "emulation.noise_kpa"),
        ("", "[emulation]\nambient_kpa = 1013", "emulation.ambient_kpa"),  # hPa
        ("", "[emulation]\nscl_part = 0", "emulation.scl_part"),
        ("", "[[fault]]\nkind='bit_errors'\nt_s=0\nduration_s=1\nrate=0", "fault.0.rate"),
        ("", "[[fault]]\nkind='bit_errors'\nt_s=0\nduration_s=1\nrate=1.5", "fault.0.rate"),
        ("", "[[fault]]\nkind='stale'\ntile='T01'\nt_s=-1\nduration_s=1", "fault.0.t_s"),
        ("", "[[fault]]\nkind='stale'\ntile='T01'\nt_s=0\nduration_s=0", "fault.0.duration_s"),
        ("", "[recovery]\nscl_line = 2", "recovery: scl_line, sda_line and reset_line have to be"),
        ("", "[recovery]\nreset_line = 3", "recovery: scl_line, sda_line and reset_line have to"),
        ("", "[recovery]\nreset_line = -1", "recovery.reset_line"),
        ("", "[recovery]\ni2c_function = 'op'", "recovery.i2c_function"),
        ("", "[recovery]\ni2c_function = 'a0 dl'", "recovery.i2c_function"),
        ("", "[sync]\nedge = 'both'", "sync: names no line, or one line twice"),
        ("", "[sync]\ninput_line = 4\noutput_line = 4", "sync: names no line, or one line twice"),
        ("", "[sync]\ninput_line = 4\nedge = 'any'", "sync.edge"),
        ("", "[sync]\ninput_line = 4\nlabel = 'a b'", "sync.label"),
        ("", "[sync]\ninput_line = 4\ndebounce_us = -1", "sync.debounce_us"),
        ("", "[reference]\nn_per_v = 30", "key 'reference.zero_v' is missing"),
        ("", "[reference]\nzero_v = 1.65", "key 'reference.n_per_v' is missing"),
        ("", "[reference]\nzero_v = 1.65\nn_per_v = 0", "0 would make every voltage 0 N"),
        ("", f"{REFERENCE}channel = 8", "reference.channel = "),
        ("", f"{REFERENCE}channel = -1", "reference.channel = "),
        # Longer than a stream can describe:
        (f"models = ['{'m' * 201}']", "", "models.0"),
        (f"models = {['static'] * 65}", "", "models"),
        ("", tile("T" * 201, channel="5"), "tile.2.serial"),
    ],
)
def test_a_value_that_makes_no_sense_is_refused(head: str, sections: str, key: str) -> None:
    assert key in refused(head, sections=sections)


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        *(
            ("mux", mux, f"0x{int(mux, 0):02x} is no TCA9548A address.*0x70 to 0x77")
            for mux in ("0x69", "0x78", "0x60", "112112")
        ),
        *(("channel", c, f"{c} is no channel.*0 to 7") for c in ("8", "-1", "70")),
        # A position in millimetres
        *(("x_m", x, "should be (greater|less) than -?1") for x in ("-21", "14.0", "1.0", "-1.0")),
    ],
)
def test_a_tile_of_no_mux_no_channel_or_no_foot_is_refused(
    key: str, value: str, expected: str
) -> None:
    text = refused(tiles=tile(**{key: value}))
    assert text.startswith(f"my.toml: tile.0.{key}")
    assert re.search(expected, text)


@pytest.mark.parametrize("zero_v", ["0.0", "-0.1", "3.3", "5.0"])
def test_a_zero_on_a_rail_is_refused(zero_v: str) -> None:
    text = refused(sections=f"[reference]\nn_per_v = 30\nzero_v = {zero_v}")
    assert f"zero_v = {float(zero_v):g} is not between the rails" in text
    assert "vref_v = 3.3" in text


def test_two_tiles_of_one_channel_or_one_serial_are_refused() -> None:
    text = refused(tiles=tile("T01", channel="3") + tile("T02", channel="3"))
    assert "mux 0x70 channel 3 is used by two tiles" in text
    assert "channel of its own" in text
    text = refused(tiles=tile("T07", channel="1") + tile("T07", channel="2"))
    assert "serial 'T07' appears twice" in text


def test_a_fault_of_an_absent_tile_or_mux_is_refused() -> None:
    text = refused(sections="[[fault]]\nkind='stale'\ntile='T9'\nt_s=0\nduration_s=1")
    assert "a fault names tile 'T9', but there are only T01, T02" in text
    text = refused(sections="[[fault]]\nkind='brown_out'\nmux=0x77\nt_s=0\nduration_s=1")
    assert "a fault names mux 0x77" in text


@pytest.mark.parametrize("kind", get_args(FaultKind))
def test_every_fault_has_a_target_of_its_kind(kind: str) -> None:
    line = f"[[fault]]\nkind='{kind}'\nt_s=0\nduration_s=1\n"
    targets = {"tile": "tile='T01'", "mux": "mux=0x70", "bus": ""}
    bus = "sda_low sda_high scl_low adapter_timeout adapter_unplugged nack_storm bit_errors"
    belongs_to = {
        **dict.fromkeys(("brown_out", "mux_reset"), "mux"),
        **dict.fromkeys((*bus.split(), *get_args(ServoFault)), "bus"),
    }.get(kind, "tile")
    if kind in get_args(ServoFault):
        assert "there is no [servo]" in refused(sections=line)
        line = "[servo]\n" + line
    for target, key in targets.items():
        if target == belongs_to:
            fault = scene(sections=line + key).fault[0]
            assert fault.target == {"tile": "T01", "mux": "0x70", "bus": "bus"}[target]
        else:
            assert kind in refused(sections=line + key)
    assert kind in refused(sections=line + "tile='T01'\nmux=0x70")


def test_a_foot_of_reference_tiles_alone_is_refused() -> None:
    reference = "reference = true\n"
    text = refused(tiles=tile("T01", more=reference) + tile("T02", channel="1", more=reference))
    assert "bear load" in text
    one_bears = tile("T01", more=reference) + tile("T02", channel="1")
    assert [t.reference for t in scene(tiles=one_bears).tile] == [True, False]


def test_a_missing_key_is_named() -> None:
    assert "key 'tile.0.channel' is missing" in refused(tiles='[[tile]]\nserial = "T01"\nmux = 112')
    assert "key 'tile' is missing" in refused(tiles="")


@pytest.mark.parametrize(
    ("head", "tiles", "sections", "parts"),
    [
        ("tile = []", "", "", ["tile = []"]),
        ("", None, "[ground]\nload_n = 3", ["ground", "kind"]),
        ("", None, "[ground]\nkind = 'moon'", ["ground", "kind", "'plate'"]),
        ("", None, "[ground]\nkind = 'plates'", ["ground", "kind", "'plate'"]),
    ],
)
def test_a_scene_without_tiles_or_with_a_ground_of_no_kind_is_refused(
    head: str, tiles: str | None, sections: str, parts: list[str]
) -> None:
    text = refused(head, tiles, sections)
    assert all(part in text for part in parts)


@pytest.mark.parametrize("name", ["", "two words", "a/b", "ü"])
def test_a_name_of_no_file_is_refused(name: str) -> None:
    with pytest.raises(SceneError, match="name = "):
        parse_scene(f'name = "{name}"\n{tile()}', where="my.toml")


def test_a_name_that_a_stream_cannot_hold_is_refused() -> None:
    text = f"name = '{'n' * 200}'\n" + tile()
    assert parse_scene(text, where="my.toml").name == "n" * 200
    with pytest.raises(SceneError, match=r"name = .*200 characters"):
        parse_scene(text.replace("'n", "'nn"), where="my.toml")


@pytest.mark.parametrize("text", ["name = ", "[tile", "name: x", 'name = "a"\nname = "b"'])
def test_a_text_that_is_no_toml_is_refused_with_its_place(text: str) -> None:
    with pytest.raises(SceneError, match=r"my\.toml: not TOML: .*(line \d|end of)") as caught:
        parse_scene(text, where="my.toml")
    assert caught.value.exit_code == 2


def test_a_path_without_a_text_is_refused(tmp_path: Path) -> None:
    missing = str(tmp_path / "nowhere.toml")
    with pytest.raises(SceneError, match=re.escape(missing)) as caught:
        load_scene(missing)
    assert "standing" in caught.value.expected
    assert caught.value.exit_code == 2
    (tmp_path / "scene.toml").write_bytes(b"name = \xff\xfe")
    for path in (tmp_path / "scene.toml", tmp_path):
        with pytest.raises(SceneError, match=re.escape(str(path))):
            load_scene(str(path))


def test_a_tile_that_has_the_chip_already_keeps_its_settings_and_its_address() -> None:
    chip, set_up = '\nchip = "bmp581"\n', "oversampling = 8\nfilter = 3\n"
    mixed = scene(
        tiles=tile("T01", more=chip + set_up)
        + tile("T02", more=chip + "address = 0x47\n")
        + tile("T03", channel="1")
    )
    first, second, third = replace_chips(mixed, "bmp581").tile
    assert (first, second) == mixed.tile[:2]
    assert third == mixed.tile[2].model_copy(update={"chip": "bmp581"})
