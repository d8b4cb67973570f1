"""The calibration file: its content, its refusals, and the paper's preset."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from devices.errors import CalibrationError
from service.estimation.calibration import (
    PRESETS,
    Calibration,
    is_increasing_cubic,
    make_paper_shape_preset,
)
from service.estimation.effects import Effects, FlowEffect, HysteresisEffect, Parameter
from service.estimation.models.static import StaticParams, compute_forces
from tests.builders.calibrations import make_calibration, make_effects, newton_tile

NUMBERS = st.floats(-100, 100)
SOME = Parameter(value=0.1, sigma=0.1)
FLOW = FlowEffect(part=SOME, stress_n=SOME, power=Parameter(value=4.0, sigma=0.1))


def make_one_tile_content() -> dict[str, Any]:
    content: dict[str, Any] = json.loads(make_calibration(newton_tile("T01")).to_json())
    return content


def list_leaves(value: object, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    if isinstance(value, dict):
        return [leaf for key, inner in value.items() for leaf in list_leaves(inner, (*path, key))]
    if isinstance(value, list):
        return [
            leaf for key, inner in enumerate(value) for leaf in list_leaves(inner, (*path, key))
        ]
    return [path]


def change(value: object) -> object:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return value * 1.0000001 + 1e-12
    return 1.0 if value is None else f"{value}x"


@settings(max_examples=50)
@given(
    c=st.tuples(NUMBERS, st.floats(0.1, 100), st.floats(0, 100), st.floats(0, 100)),
    offset_n=NUMBERS,
    scale_kpa=st.floats(0.01, 100),
    high_kpa=st.floats(0.1, 100),
    variance=st.floats(0, 1),
    serial=st.text(st.characters(exclude_categories=["C"]), min_size=1, max_size=8),
    changes=st.none()
    | st.fixed_dictionaries(
        {},
        optional={
            "refused": st.just({"ambient": "for a test"}),
            "hysteresis": st.just(HysteresisEffect(part=(SOME,) * 3, flow=FLOW)),
            "late_s": st.builds(Parameter, value=st.floats(-60, 60), sigma=st.floats(0, 1)),
        },
    ),
)
def test_a_calibration_survives_its_json_bit_by_bit(
    c: tuple[float, float, float, float],
    offset_n: float,
    scale_kpa: float,
    high_kpa: float,
    variance: float,
    serial: str,
    changes: dict[str, Any] | None,
) -> None:
    tile = newton_tile(
        serial,
        coefficients=c,
        f_offset_n=offset_n,
        p_scale_kpa=scale_kpa,
        range_kpa=(0.0, high_kpa),
        covariance=((variance, 0.1, 0.0), (0.1, 1.0, 0.0), (0.0, 0.0, 1 / 3)),
        r2=0.9999,
        effects=Effects() if changes is None else make_effects(**changes),
    )
    calibration = make_calibration(tile)
    again = Calibration.from_json_verifying_id(calibration.to_json(), where="here")
    assert again == calibration
    assert again.id == calibration.id


def test_the_id_is_of_the_content() -> None:
    one = make_calibration(newton_tile("T01"))
    assert one.id == make_calibration(newton_tile("T01")).id
    assert len(one.id) == 16
    assert int(one.id, 16) >= 0
    others = [
        make_calibration(newton_tile("T02")),
        make_calibration(newton_tile("T01", relative_misfit=1e-300)),
        one.model_copy(update={"date": "2020-01-02"}),
        one.model_copy(update={"reference": "another"}),
    ]
    assert len({one.id, *(other.id for other in others)}) == 5


def test_an_edit_of_any_field_of_the_file_is_refused() -> None:
    calibration = make_calibration(newton_tile("T01"), newton_tile("T02", rmse_n=0.1))
    text = calibration.to_json()
    paths, edited = list_leaves(json.loads(text)), 0
    assert len(paths) > 50
    for path in paths:
        content = json.loads(text)
        at = content
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = change(at[path[-1]])
        with pytest.raises(CalibrationError) as caught:
            Calibration.from_json_verifying_id(json.dumps(content), where="bench.json")
        assert "bench.json" in str(caught.value), path
        if "edited by hand or damaged" in str(caught.value):
            edited += 1
            assert path == ("id",) or calibration.id in str(caught.value)
    assert edited > 25, "its values are valid"


@pytest.mark.parametrize(
    "text",
    ["", "no json", "[]", "3", '"text"', "null", "{}", '{"id": "0", "tiles": []}', '{"id": [1]}'],
)
def test_a_text_that_is_no_calibration_is_refused_by_name(text: str) -> None:
    with pytest.raises(CalibrationError, match=r"bench\.json: not a calibration") as caught:
        Calibration.from_json_verifying_id(text, where="bench.json")
    assert "attribute" not in str(caught.value), "words of Python"


@pytest.mark.parametrize("is_refused_too", [False, True])
def test_a_tile_with_two_entries_is_refused_by_its_serial(is_refused_too: bool) -> None:
    content = make_one_tile_content()
    (tile,) = content["tiles"]
    if is_refused_too:
        content["refused"] = {tile["serial"]: "it slipped"}
    else:
        content["tiles"].append(tile | {"f_scale_n": 2 * tile["f_scale_n"]})
    with pytest.raises(CalibrationError, match=f"tile {tile['serial']} has two entries"):
        Calibration.from_json_verifying_id(json.dumps(content), where="x")


def test_an_unknown_a_missing_and_a_later_field_are_refused_by_name() -> None:
    missing = make_one_tile_content()
    del missing["tiles"][0]["p_scale_kpa"]
    for content, match in (
        (make_one_tile_content() | {"colour": "red"}, "colour"),
        (missing, r"tiles\.0\.p_scale_kpa"),
        (make_one_tile_content() | {"version": 2}, "version"),
    ):
        with pytest.raises(CalibrationError, match=match):
            Calibration.from_json_verifying_id(json.dumps(content), where="x")


@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity"])
@pytest.mark.parametrize("field", ["p_scale_kpa", "f_offset_n", "relative_misfit"])
def test_nan_and_infinity_in_a_file_are_refused(field: str, value: str) -> None:
    content = make_one_tile_content()
    content["tiles"][0][field] = float(value)
    with pytest.raises(CalibrationError, match=field):
        Calibration.from_json_verifying_id(json.dumps(content), where="x")


@pytest.mark.parametrize(
    "changes",
    [
        {"range_kpa": (5.0, 5.0)},
        {"range_kpa": (5.0, 4.0)},
        {"covariance": ((0.0, 0.0), (0.0, 0.0))},
        {"covariance": ((0.0,) * 4,) * 3},
        {"p_scale_kpa": 0.0},
        {"f_scale_n": -1.0},
        {"relative_misfit": -0.1},
        {"loop_misfit_n": -0.1},
        {"monotonic": False},
        {"coefficients": (0.0, -1.0, 0.0, 0.0)},
        {"coefficients": (0.0, 1.0, 0.0)},
        {"zero_mode": "maybe"},
        {"coefficients": (0.0, float("nan"), 0.0, 0.0)},
    ],
)
def test_a_contradictory_entry_cannot_be_made(changes: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        newton_tile("T01", **changes)


def test_a_missing_serial_is_named_with_what_there_is_and_the_remedy() -> None:
    calibration = make_calibration(newton_tile("T01"), newton_tile("T02"))
    with pytest.raises(CalibrationError) as caught:
        calibration.get_tile_or_wildcard("T07")
    text = str(caught.value)
    assert "it covers T01, T02, but not T07" in text
    serials = [f"T0{number}" for number in range(1, 10)]
    missing = calibration.describe_missing_tiles(serials)
    assert missing == "it covers T01, T02, but not T03, T04, T05, T06 and 3 more"
    assert calibration.id in text
    assert "foottile calibrate" in text


@given(
    c=st.tuples(*[st.integers(-20, 20).map(lambda i: i / 4)] * 4),
    low=st.integers(-12, 12).map(lambda i: i / 4),
    width=st.integers(1, 24).map(lambda i: i / 4),
)
def test_a_cubic_is_monotonic_exactly_if_no_point_of_a_fine_grid_falls(
    c: tuple[float, float, float, float], low: float, width: float
) -> None:
    u = low + width * np.linspace(0, 1, 4001)
    slope = c[1] + 2 * c[2] * u + 3 * c[3] * u**2
    assume(abs(slope.min()) > 1e-3)  # nearer to zero the grid cannot tell
    assert is_increasing_cubic(c, (low, low + width)) == bool(slope.min() > 0)


@pytest.mark.parametrize(
    ("coefficients", "expected"),
    [
        ((0.0, 1.0, 0.0, 0.0), True),
        ((0.0, 0.0, 1.0, 0.0), False),  # flat at the lower end: no pressure tells which force
        ((0.0, 1.0, -1.2, 0.6), True),  # 1 - 2.4 u + 1.8 u^2 is at least 0.2, at u = 2/3
        ((0.0, 1.0, -1.8, 1.0), False),  # 1 - 3.6 u + 3 u^2 is -0.08 at u = 0.6, positive at ends
        ((0.0, 1.0, 0.0, -1 / 3 - 1e-9), False),  # just flat at the upper end
    ],
)
def test_monotony_is_judged_at_both_ends_and_in_between(
    coefficients: tuple[float, float, float, float], expected: bool
) -> None:
    assert is_increasing_cubic(coefficients, (0.0, 1.0)) is expected


# --- the paper's equation 2, hardware.md 7 --------------------------------------------------------


def test_the_papers_preset_has_the_papers_shape_at_41_45_n_per_unit() -> None:
    tile = PRESETS["paper-eq2-shape"]().get_tile_or_wildcard("any serial at all")
    assert tile.f_scale_n == pytest.approx(41.45, abs=0.005)
    gauge_kpa = np.linspace(0.0, 15.0, 61)
    force_n = compute_forces(StaticParams.from_calibrations([tile]), gauge_kpa[:, None]).force_n[
        :, 0
    ]
    p = gauge_kpa / 15.0
    assert force_n == pytest.approx((0.13 * p**3 + 0.02354 * p**2 + 0.5702 * p) * 41.45, abs=0.004)
    assert (force_n[0], force_n[-1]) == (0.0, pytest.approx(30.0, abs=1e-12))


def test_the_papers_preset_has_an_assumed_scale_uncertain_by_a_tenth() -> None:
    tile = make_paper_shape_preset().get_tile_or_wildcard("T01")
    assert (tile.absolute_scale, tile.relative_misfit, tile.monotonic) == ("assumed", 0.1, True)
    assert tile.range_kpa == (0.0, 15.0)
    assert "assumed" in make_paper_shape_preset().reference
