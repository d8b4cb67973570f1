"""The automatic tare: it follows a warming dome, and tares no load away.

A count is 130/1023 kPa or one newton (see tests/builders). A sealed bubble of 100 kPa gains
0.336 kPa or 2.64 counts a kelvin, while `temperature_raw` falls by 5.35.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from devices.chips.mpl115a2 import TADC_PER_KELVIN
from devices.chips.pressure_chips import Compensation
from devices.frames import NOT_READ, FrameBatch
from service.estimation.calibration import Calibration, make_paper_shape_preset
from service.estimation.tare.automatic import (
    RECOVERY_NS,
    RENEWAL_NS,
    SHIFT_MAX_KPA,
    TARE_INTERVAL_MIN_NS,
    TOTAL_SHIFT_MAX_KPA,
    WINDOW_NS,
    FlightTareResult,
    propose_first_tare_between_steps,
    propose_flight_tare,
)
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import TareFrames
from tests.builders.arrays import COUNT_KPA, UNLOADED_KPA, UTC_NS, make_array
from tests.builders.calibrations import make_calibration, make_tare
from tests.builders.frames import loaded_frames

COUNTS_PER_K = UNLOADED_KPA / 298.0 / COUNT_KPA
SECOND_NS = 1_000_000_000
INFO = make_array(2)
RIG = make_calibration(*INFO.serials)


def draw_frames(
    at_s: float, counts: Any = 0.0, *, warmer_k: float = 0.0, seconds: float = 5.0
) -> FrameBatch:
    """Draw frames that end at `at_s`, so many counts above 500, 100 a second."""
    n = round(seconds * 100)
    rng = np.random.default_rng(round(at_s))
    noise_counts = rng.normal(0.0, 0.3, (n, 2))
    return loaded_frames(
        rng.normal(0.0, 0.9, (n, 2)) + np.asarray(counts),
        t_mono_ns=round(at_s * SECOND_NS) + 10_000_000 * np.arange(1 - n, 1),
        temperature_raw=np.rint(480 + TADC_PER_KELVIN * warmer_k + noise_counts),
    )


def collect_recent(frames: FrameBatch, calibration: Calibration = RIG) -> TareFrames:
    return TareFrames(frames, Compensation(INFO.tiles), calibration, INFO.serials)


def tare_by_hand(at_s: float = 0.0, counts: float = 0.0) -> Tare:
    return make_tare(
        2,
        baseline_kpa=UNLOADED_KPA + counts * COUNT_KPA,
        baseline_sigma_kpa=0.01,
        noise_kpa=COUNT_KPA,
        t_ns=UTC_NS + round(at_s * SECOND_NS),
        end_s=0.25,
        frames=25,
        source="unloaded",
    )


def propose(
    frames: FrameBatch,
    present: Tare | None = None,
    last_manual: Tare | None = None,
    *,
    free_s: float = 1e9,
    bears: tuple[bool, bool] = (True, True),
) -> FlightTareResult:
    """Propose a tare for a foot that has had no contact for `free_s`."""
    present = tare_by_hand() if present is None else present
    return propose_flight_tare(
        collect_recent(frames),
        present=present,
        last_manual=present if last_manual is None else last_manual,
        no_contact_since_t_ns=int(frames.t_ns[-1]) - round(free_s * SECOND_NS),
        is_load_bearing=np.array(bears),
    )


def follow_an_hour(
    counts_at: Callable[[float], float], warmer_at: Callable[[float], float] = lambda _: 0.0
) -> list[Tare]:
    """List all tares of an hour with a proposal every 20 s, after one by hand at 0 s."""
    tares = [tare_by_hand()]
    for at_s in range(20, 3600, 20):
        frames = draw_frames(at_s, counts_at(at_s), warmer_k=warmer_at(at_s), seconds=2.0)
        found = propose(frames, tares[-1], tares[0])
        if found.tare is not None:
            tares.append(found.tare)
    return tares


# --- drift is followed ----------------------------------------------------------------------------


def test_a_warmer_dome_in_the_air_is_tared_with_a_reason() -> None:
    found = propose(draw_frames(300.0, COUNTS_PER_K, warmer_k=1.0))
    assert found.rejection is None
    assert found.tare is not None
    assert (found.tare.source, found.tare.t_ns) == ("flight", UTC_NS + 300 * SECOND_NS)
    assert found.tare.baseline_kpa == pytest.approx([UNLOADED_KPA + 0.336] * 2, abs=0.1)
    assert "in the air" in found.reason
    assert "T01 +0.35 kPa from the tare before" in found.reason


def test_a_dome_that_warms_for_an_hour_is_followed() -> None:
    # 9 K with a time constant of 15 min, 0.6 K/min at first
    def warmer_at(at_s: float) -> float:
        return float(9.0 * (1.0 - np.exp(-at_s / 900.0)))

    tares = follow_an_hour(lambda s: COUNTS_PER_K * warmer_at(s), warmer_at)
    assert len(tares) > 10
    for before, after in pairwise(tares):
        assert after.t_ns - before.t_ns >= TARE_INTERVAL_MIN_NS
    for tare in tares[1:]:
        truth_kpa = UNLOADED_KPA * (1 + warmer_at((tare.t_ns - UTC_NS) * 1e-9) / 298.0)
        assert tare.baseline_kpa == pytest.approx([truth_kpa] * 2, abs=0.12)
    assert UTC_NS + 3600 * SECOND_NS - tares[-1].t_ns < RENEWAL_NS + 60 * SECOND_NS


def test_a_constant_baseline_is_renewed_before_it_is_old() -> None:
    assert propose(draw_frames(300.0)).tare is None
    found = propose(draw_frames(RENEWAL_NS / SECOND_NS + 1.0))
    assert found.tare is not None
    assert "nothing has moved in 15 min" in found.reason
    assert len(follow_an_hour(lambda _: 0.0)) <= 6


@pytest.mark.parametrize(
    ("at_s", "kelvin", "is_tared"),
    [
        (59.0, 0.4, False),
        (61.0, 0.4, True),
        # 2 K are 0.67 kPa, which is 134 s at 0.005 kPa/s
        (120.0, 2.0, False),
        (160.0, 2.0, True),
    ],
)
def test_tares_are_a_minute_apart_and_follow_a_kelvin_a_minute(
    at_s: float, kelvin: float, is_tared: bool
) -> None:
    found = propose(draw_frames(at_s, kelvin * COUNTS_PER_K, warmer_k=kelvin))
    assert (found.tare is not None, found.rejection) == (is_tared, None)


@pytest.mark.parametrize("weather_counts", [0.0, 10.0, -4.0])
def test_a_bare_tile_follows_the_weather_and_prevents_no_tare(weather_counts: float) -> None:
    frames = draw_frames(600.0, [2.0 * COUNTS_PER_K, weather_counts], warmer_k=2.0)
    found = propose(frames, bears=(True, False))
    assert found.rejection is None
    assert found.tare is not None
    expected_kpa = UNLOADED_KPA + weather_counts * COUNT_KPA
    assert found.tare.baseline_kpa[1] == pytest.approx(expected_kpa, abs=0.05)
    assert "T01" in found.reason
    assert propose(frames).rejection is not None, "a dome would be in doubt"


# --- loads are not tared away ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("counts", "kelvin", "reason"),
    [
        ([0.0, 3.0], 0.0, r"tile T02 reads \+0\.4.*tare by hand"),
        # 1 K explains 0.34 kPa, half is uncertain: 0.5 kPa more are a load.
        ([COUNTS_PER_K + 4.0] * 2, 1.0, "explain 0.3"),
    ],
)
def test_a_shift_that_temperature_does_not_explain_is_rejected(
    counts: list[float], kelvin: float, reason: str
) -> None:
    found = propose(draw_frames(300.0, counts, warmer_k=kelvin))
    assert found.tare is None
    assert re.search(reason, found.rejection or "")


@pytest.mark.slow
@pytest.mark.parametrize("newtons_per_minute", [0.02, 0.1, 0.5, 3.0])
def test_hardly_any_of_a_slowly_growing_load_is_tared_away(newtons_per_minute: float) -> None:
    tares = follow_an_hour(lambda s: min(newtons_per_minute * s / 60.0, 30.0))
    lost_kpa = tares[-1].baseline_kpa - UNLOADED_KPA
    assert (lost_kpa < TOTAL_SHIFT_MAX_KPA + 0.05).all()


@pytest.mark.parametrize(("newtons", "tares"), [(1.0, None), (2.0, 1), (8.0, 1)])
def test_a_light_load_that_stays_is_not_tared_away(newtons: float, tares: int | None) -> None:
    found = follow_an_hour(lambda s: newtons if s > 100 else 0.0)
    assert (found[-1].baseline_kpa - UNLOADED_KPA < SHIFT_MAX_KPA + 0.05).all()
    assert tares is None or len(found) == tares


def test_many_small_shifts_from_the_tare_by_hand_are_rejected() -> None:
    lately = replace(tare_by_hand(200.0, counts=2.0), source="flight")
    found = propose(draw_frames(300.0, 3.0), lately, tare_by_hand())
    assert found.tare is None
    assert "against the last tare by hand" in (found.rejection or "")


def test_a_foot_in_contact_or_just_lifted_is_not_tared() -> None:
    frames = draw_frames(300.0, 1.0)
    short_s = (RECOVERY_NS + WINDOW_NS) / SECOND_NS
    for free_s, is_tared in ((0.0, False), (short_s - 0.02, False), (short_s + 0.05, True)):
        assert (propose(frames, free_s=free_s).tare is not None) is is_tared


def test_a_flight_before_the_last_contact_does_not_count() -> None:
    # In the air, then a light touch, then a movement without rest.
    counts = np.zeros((500, 1))
    counts[300:400] = 30.0
    counts[400:] = 6.0 * np.sin(np.arange(100) / 2.0)[:, None]
    frames = draw_frames(1000.0, counts)
    assert propose(frames, free_s=0.9).tare is None
    assert propose(frames).tare is not None


def test_a_foot_that_moves_or_has_a_silent_tile_is_not_tared() -> None:
    for counts in (8.0 * np.sin(np.arange(500) / 5.0)[:, None], [0.0, np.nan]):
        assert propose(draw_frames(1000.0, counts)) == FlightTareResult()


# --- the first tare -------------------------------------------------------------------------------


def make_steps(rest: float = 0.0) -> np.ndarray:
    """Make two steps of a second each, and `rest` counts between and after them."""
    counts = np.full((500, 1), rest)
    counts[50:150] += 40.0
    counts[250:350] += 40.0
    return counts


def test_a_stepping_foot_is_first_tared_between_two_steps() -> None:
    found = propose_first_tare_between_steps(collect_recent(draw_frames(20.0, make_steps(3.0))))
    assert found.tare is not None
    assert found.tare.source == "flight"
    assert found.tare.baseline_kpa == pytest.approx([UNLOADED_KPA + 3 * COUNT_KPA] * 2, abs=0.1)
    assert "between two steps" in found.reason


def test_a_step_counts_where_temperature_is_seldom_read() -> None:
    counts = np.zeros((500, 1))
    counts[100:120] = 40.0  # 0.2 s
    frames = draw_frames(20.0, counts)
    frames.temperature_raw[np.arange(500) % 4 > 0] = NOT_READ
    assert propose_first_tare_between_steps(collect_recent(frames)).tare is not None


@pytest.mark.parametrize(
    ("counts", "calibration"),
    [
        (np.array(0.0), RIG),
        (np.array(3.0), RIG),
        (np.array(11.0), RIG),
        (make_steps(13.0), RIG),
        (make_steps(), make_paper_shape_preset()),
        (np.where(np.arange(500) % 100, 0.0, 60.0)[:, None], RIG),
    ],
    ids=["hangs", "stands light", "stands", "rests off the rig", "has no rig", "outliers"],
)
def test_a_foot_without_certain_steps_is_not_tared(
    counts: np.ndarray, calibration: Calibration
) -> None:
    recent = collect_recent(draw_frames(20.0, counts), calibration)
    assert propose_first_tare_between_steps(recent) == FlightTareResult()
