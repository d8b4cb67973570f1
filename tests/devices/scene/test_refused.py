"""Scenes that are refused, each with the key that is wrong."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest

from devices.errors import SceneError
from devices.scene.emulation_sections import FaultKind, ServoFault
from devices.scene.scene_file import load_scene, parse_scene
from tests.devices.scene.texts import refused, scene, tile


@pytest.mark.parametrize(
    ("head", "key"),
    [("colour = 1", "colour"), ("Rate_hz = 1", "Rate_hz")],
)
def test_an_unknown_key_is_named(head: str, key: str) -> None:
    assert refused(head) == (f"my.toml: unknown key {key!r}. Check its spelling, or remove it")


@pytest.mark.parametrize(
    ("sections", "key"),
    [
        ("[array]\nscl = 400000", "array.scl"),
        ("[servo]\nbaud = 57600", "servo.baud"),
        ("[reference]\nzero_v = 1\nn_per_v = 1\noffset_n = 1", "reference.offset_n"),
        ("[ground]\nkind = 'rolling'\nload_kg = 1", "load_kg"),
        ("[ground]\nkind = 'none'\nload_n = 1", "load_n"),
        ("[emulation]\nnoise = 1", "emulation.noise"),
        ("[[fault]]\nkind='stale'\ntile='T01'\nt_s=0\nduration_s=1\nseverity=3", "severity"),
        (tile("T03", channel="5", more="temperature = 3"), "tile.2.temperature"),
    ],
)
def test_an_unknown_key_is_named_with_its_section(sections: str, key: str) -> None:
    text = refused(sections=sections)
    assert "unknown key" in text
    assert key in text
    assert "Check its spelling, or remove it" in text


WRONG_TYPES = [
    ("rate_hz = '100'", "", "rate_hz"),
    ("rate_hz = true", "", "rate_hz"),
    ("models = 'static'", "", "models"),
    ("models = [1]", "", "models.0"),
    ("calibration = 3", "", "calibration"),
    ("", "[array]\nscl_hz = '4'", "array.scl_hz"),
    ("", "[array]\nwait_ms = true", "array.wait_ms"),
    ("", "[array]\nschedule = 'fast'", "array.schedule"),
    ("", "[servo]\nid = '1'", "servo.id"),
    ("", "[servo]\nid = true", "servo.id"),
    ("", "[servo]\nid = 1.5", "servo.id"),
    ("", "[servo]\nsign = 2", "servo.sign"),
    ("", "[servo]\nmodel = 'AX-12'", "servo.model"),
    ("", "[ground]\nkind = 'rolling'\nload_n = '8'", "load_n"),
    ("", "[emulation]\ngas = 1", "emulation.gas"),
    ("", "[emulation]\ngas = 'yes'", "emulation.gas"),
    ("", "[emulation]\nread_during_conversion = 'random'", "read_during_conversion"),
    ("", "[[fault]]\nkind = 'fire'\ntile = 'T01'\nt_s = 0\nduration_s = 1", "fault.0.kind"),
]


@pytest.mark.parametrize(("head", "sections", "key"), WRONG_TYPES)
def test_a_wrong_type_is_refused_and_not_converted(head: str, sections: str, key: str) -> None:
    text = refused(head, sections=sections)
    assert f"{key} = " in text
    assert re.search(r"[Ii]nput should be", text), "it has to say what would be right"


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"channel": '"4"'}, "tile.0.channel"),
        ({"channel": "true"}, "tile.0.channel"),
        ({"channel": "1.0"}, "tile.0.channel"),
        ({"mux": '"0x70"'}, "tile.0.mux"),
        ({"x_m": '"0"'}, "tile.0.x_m"),
        ({"x_m": "true"}, "tile.0.x_m"),
    ],
)
def test_a_wrong_type_in_a_tile_is_refused(changes: dict[str, str], key: str) -> None:
    text = refused(tiles=tile(**changes))
    assert f"{key} = " in text
    assert "should be a valid" in text


@pytest.mark.parametrize("mux", ["0x69", "0x78", "0x60", "112112"])
def test_an_address_that_no_mux_has_is_refused(mux: str) -> None:
    text = refused(tiles=tile(mux=mux))
    assert text.startswith("my.toml: tile.0.mux")
    assert f"0x{int(mux, 0):02x} is no TCA9548A address" in text
    assert "0x70 to 0x77" in text


@pytest.mark.parametrize("channel", ["8", "-1", "70"])
def test_a_channel_that_no_mux_has_is_refused(channel: str) -> None:
    text = refused(tiles=tile(channel=channel))
    assert text.startswith("my.toml: tile.0.channel")
    assert f"{channel} is no channel" in text
    assert "0 to 7" in text


@pytest.mark.parametrize("x_m", ["-21", "14.0", "1.0", "-1.0"])
def test_a_position_in_millimetres_is_refused(x_m: str) -> None:
    text = refused(tiles=tile(x_m=x_m))
    assert "tile.0.x_m = " in text
    assert re.search(r"should be (greater|less) than -?1", text)


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ("scl_line = 2", "recovery: scl_line, sda_line and reset_line have to be different"),
        ("reset_line = 3", "recovery: scl_line, sda_line and reset_line have to be different"),
        ("reset_line = -1", "recovery.reset_line"),
        ("sda_line = '2'", "recovery.sda_line"),
        ("reset_line = true", "recovery.reset_line"),
        ("i2c_function = 'op'", "recovery.i2c_function"),
        ("i2c_function = 'a0 dl'", "recovery.i2c_function"),
        ("reset = 17", "unknown key 'recovery.reset'"),
    ],
)
def test_lines_that_make_no_sense_are_refused(line: str, key: str) -> None:
    assert key in refused(sections=f"[recovery]\n{line}")


@pytest.mark.parametrize("key", ["sign", "protocol"])
def test_true_is_no_number(key: str) -> None:
    text = refused(sections=f"[servo]\n{key} = true")
    assert f"servo.{key} = True" in text


def test_a_servo_of_protocol_1_has_one_id_more() -> None:
    old = refused(sections="[servo]\nprotocol = 1\nid = 254")
    assert "servo.id = 254: 254 is no servo id of protocol 1; expected 0 to 253" in old
    new = refused(sections="[servo]\nid = 253")
    assert "servo.id = 253: 253 is no servo id of protocol 2; expected 0 to 252" in new
    assert "servo.protocol = 3" in refused(sections="[servo]\nprotocol = 3\nid = 1")


def test_a_servo_that_would_not_turn_the_segment_is_refused() -> None:
    # The angle would be constant, and the emulated servo would divide by it.
    assert "servo.ratio = 0" in refused(sections="[servo]\nratio = 0")
    assert "servo.ratio = -0" in refused(sections="[servo]\nratio = -0.0")


def test_two_tiles_on_one_channel_are_refused() -> None:
    text = refused(tiles=tile("T01", channel="3") + tile("T02", channel="3"))
    assert "mux 0x70 channel 3 is used by two tiles" in text
    assert "channel of its own" in text


def test_the_same_channel_of_another_mux_is_another_plug() -> None:
    assert len(scene(tiles=tile("T01") + tile("T02", mux="0x71")).tile) == 2


def test_two_tiles_of_one_serial_are_refused() -> None:
    text = refused(tiles=tile("T07", channel="1") + tile("T07", channel="2"))
    assert "serial 'T07' appears twice" in text


def test_a_fault_of_a_tile_that_is_not_there_is_refused() -> None:
    text = refused(sections="[[fault]]\nkind='stale'\ntile='T9'\nt_s=0\nduration_s=1")
    assert "a fault names tile 'T9', but there are only T01, T02" in text


def test_a_fault_of_a_mux_that_is_not_there_is_refused() -> None:
    text = refused(sections="[[fault]]\nkind='brown_out'\nmux=0x77\nt_s=0\nduration_s=1")
    assert "a fault names mux 0x77" in text


@pytest.mark.parametrize("kind", get_args(FaultKind))
def test_every_fault_names_what_fails_and_nothing_else(kind: str) -> None:
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


def test_a_missing_key_is_named() -> None:
    assert "key 'tile.0.channel' is missing" in refused(tiles='[[tile]]\nserial = "T01"\nmux = 112')
    assert "key 'tile' is missing" in refused(tiles="")


def test_a_foot_of_reference_tiles_alone_is_refused() -> None:
    reference = "reference = true\n"
    text = refused(tiles=tile("T01", more=reference) + tile("T02", channel="1", more=reference))
    assert "bear load" in text
    one_bears = tile("T01", more=reference) + tile("T02", channel="1")
    assert [t.reference for t in scene(tiles=one_bears).tile] == [True, False]


def test_a_scene_without_tiles_is_refused() -> None:
    assert "tile = []" in refused("tile = []", tiles="")


@pytest.mark.parametrize("sections", ["[ground]\nload_n = 3", "[ground]\nkind = 'moon'"])
def test_a_ground_of_no_kind_is_refused(sections: str) -> None:
    text = refused(sections=sections)
    assert "ground" in text
    assert "kind" in text


@pytest.mark.parametrize("name", ["", "two words", "a/b", "ü"])
def test_a_name_that_could_be_no_file_name_is_refused(name: str) -> None:
    with pytest.raises(SceneError, match="name = "):
        parse_scene(f'name = "{name}"\n{tile()}', where="my.toml")


@pytest.mark.parametrize("text", ["name = ", "[tile", "name: x", 'name = "a"\nname = "b"'])
def test_what_is_not_toml_is_refused_with_its_place(text: str) -> None:
    with pytest.raises(SceneError, match=r"my\.toml: not TOML: .*(line \d|end of)") as caught:
        parse_scene(text, where="my.toml")
    assert caught.value.exit_code == 2


def test_a_missing_file_is_refused_with_the_names_that_there_are(tmp_path: Path) -> None:
    path = str(tmp_path / "nowhere.toml")
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert path in str(caught.value)
    assert "standing" in caught.value.expected
    assert caught.value.exit_code == 2


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_bytes(b"name = \xff\xfe")
    with pytest.raises(SceneError, match=r"scene\.toml"):
        load_scene(str(path))


def test_a_folder_is_no_scene(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=re.escape(str(tmp_path))):
        load_scene(str(tmp_path))


@pytest.mark.parametrize(
    ("head", "serial", "key"),
    [
        ("rate_hz = 1e-4", "T01", "rate_hz = 0.0001"),
        (f"models = ['{'m' * 201}']", "T01", "models.0"),
        (f"models = {['static'] * 65}", "T01", "models"),
        ("", "T" * 201, "tile.0.serial"),
    ],
)
def test_what_could_not_be_said_of_a_stream_is_refused_where_it_is_read(
    head: str, serial: str, key: str
) -> None:
    assert f"my.toml: {key}" in refused(head, tile(serial))


def test_a_name_that_could_not_be_said_of_a_stream_is_refused() -> None:
    text = f"name = '{'n' * 200}'\n" + tile()
    assert parse_scene(text, where="my.toml").name == "n" * 200
    with pytest.raises(SceneError, match=r"name = .*200 characters"):
        parse_scene(text.replace("'n", "'nn"), where="my.toml")


def test_the_slowest_rate_that_can_be_said_of_a_stream_is_read() -> None:
    assert scene("rate_hz = 0.001").rate_hz == 0.001
