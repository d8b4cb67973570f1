"""Numbers in a scene that are none, or make no sense, are refused with their key."""

from __future__ import annotations

import pytest

from tests.devices.scene.texts import refused, tile

NOT_FINITE = ["nan", "inf", "-inf"]


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize(
    ("section", "key"),
    [
        ("", "rate_hz"),
        ("array", "scl_hz"),
        ("array", "wait_ms"),
        ("array", "conversion_ms"),
        ("servo", "ratio"),
        ("servo", "rate_hz"),
        ("servo", "ankle_travel_m_per_rad"),
        ("emulation", "noise_kpa"),
        ("emulation", "correlated_ms"),
        ("emulation", "repeatability"),
        ("emulation", "ambient_degc"),
        ("emulation", "ambient_kpa"),
        ("emulation", "temperature_step_k"),
        ("emulation", "temperature_step_s"),
        ("emulation", "head_kpa"),
        ("emulation", "head_s"),
        ("emulation", "clip_kpa"),
    ],
)
def test_a_number_that_is_none_is_refused(section: str, key: str, value: str) -> None:
    line = f"{key} = {value}"
    text = refused(line) if not section else refused(sections=f"[{section}]\n{line}")
    assert f"{key} = {value}" in text


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize(
    ("kind", "key"),
    [
        ("plate", "load_n"),
        ("plate", "sway_m"),
        ("rolling", "load_n"),
        ("rolling", "radius_m"),
        ("rolling", "speed_m_s"),
        ("rolling", "patch_m"),
        ("indentation", "load_n"),
        ("indentation", "stroke_s"),
        ("indentation", "soak_k"),
        *(
            (kind, key)
            for kind in ("poppy", "mud")
            for key in (
                "mass_kg",
                "drop_m",
                "leg_n_per_m",
                "stand_s",
                "pitch_rad",
                "sole_m2",
                "dome_share",
                "strength_n_per_cm3",
            )
        ),
        ("mud", "viscosity_pa_s"),
        ("mud", "suction_kpa"),
        ("mud", "head_kpa_per_m"),
        ("mud", "temperature_step_k"),
    ],
)
def test_a_number_that_is_none_is_refused_in_a_ground(kind: str, key: str, value: str) -> None:
    assert f"{key} = {value}" in refused(sections=f"[ground]\nkind = '{kind}'\n{key} = {value}")


@pytest.mark.parametrize("value", NOT_FINITE)
def test_a_number_that_is_none_is_refused_in_a_position_or_a_fault(value: str) -> None:
    assert f"tile.0.x_m = {value}" in refused(tiles=tile(x_m=value))
    for t_s, duration_s in ((value, "1"), ("0", value)):
        text = refused(
            sections="[[fault]]\nkind = 'stale'\ntile = 'T01'\n"
            f"t_s = {t_s}\nduration_s = {duration_s}"
        )
        assert f"= {value}" in text


@pytest.mark.parametrize(
    ("head", "sections", "key"),
    [
        ("rate_hz = -1", "", "rate_hz"),
        ("", "[array]\nscl_hz = 0", "array.scl_hz"),
        ("", "[array]\nscl_hz = 400", "array.scl_hz"),  # kHz
        ("", "[array]\nscl_hz = 400000000", "array.scl_hz"),
        ("", "[array]\nwait_ms = 0", "array.wait_ms"),
        ("", "[array]\nconversion_ms = -1.6", "array.conversion_ms"),
        ("", "[servo]\nid = 253", "servo.id"),
        ("", "[servo]\nrate_hz = 0", "servo.rate_hz"),
        ("", "[ground]\nkind = 'plate'\nload_n = -3", "load_n"),
        ("", "[ground]\nkind = 'indentation'\nrepeats = 1", "repeats"),
        ("", "[emulation]\nnoise_kpa = -0.1", "emulation.noise_kpa"),
        ("", "[emulation]\nambient_kpa = 1013", "emulation.ambient_kpa"),  # hPa
        ("", "[ground]\nkind = 'poppy'\ndrop_m = 10", "drop_m"),  # cm
        ("", "[ground]\nkind = 'poppy'\nmass_kg = 909", "mass_kg"),  # g
        ("", "[ground]\nkind = 'poppy'\ndome_share = 80", "dome_share"),  # %
        ("", "[ground]\nkind = 'mud'\nhead_kpa_per_m = 1.65", "head_kpa_per_m"),  # per 0.1 m
        ("", "[array]\ntemperature_every = 0", "array.temperature_every"),
        ("", "[array]\nbroadcast_channels = 0", "array.broadcast_channels"),
        ("", "[array]\nbroadcast_channels = 65", "array.broadcast_channels"),
        ("", "[emulation]\nscl_part = 0", "emulation.scl_part"),
        ("", "[[fault]]\nkind='bit_errors'\nt_s=0\nduration_s=1\nrate=0", "fault.0.rate"),
        ("", "[[fault]]\nkind='bit_errors'\nt_s=0\nduration_s=1\nrate=1.5", "fault.0.rate"),
        ("", "[[fault]]\nkind='stale'\ntile='T01'\nt_s=-1\nduration_s=1", "fault.0.t_s"),
        ("", "[[fault]]\nkind='stale'\ntile='T01'\nt_s=0\nduration_s=0", "fault.0.duration_s"),
    ],
)
def test_a_number_that_makes_no_sense_is_refused(head: str, sections: str, key: str) -> None:
    assert key in refused(head, sections=sections)


def reference_refused(**changes: str) -> str:
    keys = {"zero_v": "1.65", "n_per_v": "30.0"} | changes
    lines = "\n".join(f"{key} = {value}" for key, value in keys.items() if value)
    return refused(sections=f"[reference]\n{lines}")


@pytest.mark.parametrize("key", ["zero_v", "n_per_v"])
def test_nobody_but_the_user_knows_the_scale_of_a_reference_force(key: str) -> None:
    assert f"key 'reference.{key}' is missing" in reference_refused(**{key: ""})


@pytest.mark.parametrize("value", [*NOT_FINITE, "'3.3'", "true"])
@pytest.mark.parametrize("key", ["vref_v", "zero_v", "n_per_v"])
def test_a_scale_that_is_no_number_is_refused(key: str, value: str) -> None:
    assert f"reference.{key} = " in reference_refused(**{key: value})


@pytest.mark.parametrize("channel", ["8", "-1", "true", "'0'"])
def test_an_input_that_no_converter_has_is_refused(channel: str) -> None:
    assert "reference.channel = " in reference_refused(channel=channel)


@pytest.mark.parametrize("zero_v", ["0.0", "-0.1", "3.3", "5.0"])
def test_a_zero_on_a_rail_is_refused(zero_v: str) -> None:
    text = reference_refused(zero_v=zero_v)
    assert f"zero_v = {float(zero_v):g} is not between the rails" in text
    assert "vref_v = 3.3" in text


def test_a_scale_that_would_make_every_voltage_no_force_is_refused() -> None:
    assert "0 would make every voltage 0 N" in reference_refused(n_per_v="0")
