"""The automatic tare: it follows a dome that warms up, and tares no load away.

A count is 130/1023 kPa or one newton (see tests/builders). A sealed bubble of 100 kPa gains
0.336 kPa or 2.64 counts a kelvin, while `temperature_raw` falls by 5.35.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from devices.chips.compensation import Compensation
from devices.chips.mpl115a2 import TADC_PER_KELVIN
from devices.frames import NOT_READ, ArrayInfo, FrameBatch
from service.estimation.calibration import Calibration, make_paper_shape_preset
from service.estimation.tare.automatic import (
    RECOVERY_NS,
    RENEWAL_NS,
    SHIFT_MAX_KPA,
    TARE_INTERVAL_MIN_NS,
    TOTAL_SHIFT_MAX_KPA,
    WINDOW_NS,
    FlightTareResult,
    propose_first_flight_tare,
    propose_flight_tare,
)
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import TareFrames
from tests.builders.arrays import COUNT_KPA, UNLOADED_KPA, UTC_NS, make_array
from tests.builders.calibrations import make_calibration, make_tare
from tests.builders.frames import loaded_frames

COUNTS_PER_K = UNLOADED_KPA / 298.0 / COUNT_KPA
PERIOD_NS = 10_000_000
SECOND_NS = 1_000_000_000
TILES = 2


class Bench:
    """Frames of the last seconds at some instant, and what a look at them finds."""

    def __init__(self, info: ArrayInfo, calibration: Calibration) -> None:
        self.info = info
        self.calibration = calibration
        self._compensation = Compensation(info.tiles)

    def frames(
        self, at_s: float, counts: Any = 0.0, *, warmer_k: float = 0.0, seconds: float = 5.0
    ) -> FrameBatch:
        """Frames that end at `mid_t_s`, so many counts above 500."""
        n = round(seconds * SECOND_NS / PERIOD_NS)
        rng = np.random.default_rng(round(at_s))
        t_mono_ns = round(at_s * SECOND_NS) + PERIOD_NS * np.arange(1 - n, 1)
        temperature_raw = np.rint(
            480 + TADC_PER_KELVIN * warmer_k + rng.normal(0.0, 0.3, (n, TILES))
        )
        forces_n = rng.normal(0.0, 0.9, (n, TILES)) + np.asarray(counts)
        return loaded_frames(forces_n, t_mono_ns=t_mono_ns, temperature_raw=temperature_raw)

    def look(
        self,
        frames: FrameBatch,
        present: Tare,
        anchor: Tare | None = None,
        *,
        free_s: float = 1e9,
        bears: tuple[bool, ...] = (True,) * TILES,
    ) -> FlightTareResult:
        """A look at frames of a foot that has had no contact for `free_s`."""
        return propose_flight_tare(
            self._seen(frames),
            present=present,
            last_manual=present if anchor is None else anchor,
            no_contact_since_t_ns=int(frames.t_ns[-1]) - round(free_s * SECOND_NS),
            is_load_bearing=np.array(bears),
        )

    def first(self, frames: FrameBatch) -> FlightTareResult:
        """A look at frames of a foot that was never tared."""
        return propose_first_flight_tare(self._seen(frames))

    def _seen(self, frames: FrameBatch) -> TareFrames:
        return TareFrames(frames, self._compensation, self.calibration, self.info.serials)


@pytest.fixture(scope="module")
def bench() -> Bench:
    info = make_array(TILES)
    return Bench(info, make_calibration(*info.serials))


def by_hand(at_s: float = 0.0, counts: float = 0.0) -> Tare:
    return make_tare(
        TILES,
        baseline_kpa=UNLOADED_KPA + counts * COUNT_KPA,
        baseline_sigma_kpa=0.01,
        noise_kpa=COUNT_KPA,
        t_ns=UTC_NS + round(at_s * SECOND_NS),
        end_s=0.25,
        frames=25,
        source="unloaded",
    )


def followed(bench: Bench, counts_at: Callable[[float], float], **how: Any) -> list[Tare]:
    """All tares of an hour with a look every 20 s, the one by hand at 0 s first."""
    tares = [by_hand()]
    warmer_at = how.get("warmer_at", lambda _: 0.0)
    for at_s in range(20, 3600, 20):
        frames = bench.frames(at_s, counts_at(at_s), warmer_k=warmer_at(at_s), seconds=2.0)
        found = bench.look(frames, tares[-1], tares[0])
        if found.tare is not None:
            tares.append(found.tare)
    return tares


# --- it follows -----------------------------------------------------------------------------------


def test_a_dome_that_has_warmed_up_in_the_air_is_tared_anew_and_the_history_says_why(
    bench: Bench,
) -> None:
    found = bench.look(bench.frames(300.0, COUNTS_PER_K, warmer_k=1.0), by_hand())
    assert found.rejection is None
    assert found.tare is not None
    assert found.tare.source == "flight"
    assert found.tare.t_ns == UTC_NS + 300 * SECOND_NS
    assert found.tare.baseline_kpa == pytest.approx([UNLOADED_KPA + 0.336] * 2, abs=0.1)
    assert "in the air" in found.reason
    assert "T01 +0.35 kPa from the tare before" in found.reason


def test_a_dome_that_warms_for_an_hour_is_followed(bench: Bench) -> None:
    # 9 K with a time constant of 15 min, 0.6 K/min at first
    def warmer_at(at_s: float) -> float:
        return float(9.0 * (1.0 - np.exp(-at_s / 900.0)))

    tares = followed(bench, lambda s: COUNTS_PER_K * warmer_at(s), warmer_at=warmer_at)
    assert len(tares) > 10
    for before, after in pairwise(tares):
        assert after.t_ns - before.t_ns >= TARE_INTERVAL_MIN_NS
    for tare in tares[1:]:
        truth_kpa = UNLOADED_KPA * (1 + warmer_at((tare.t_ns - UTC_NS) * 1e-9) / 298.0)
        assert tare.baseline_kpa == pytest.approx([truth_kpa] * 2, abs=0.12)
    assert UTC_NS + 3600 * SECOND_NS - tares[-1].t_ns < RENEWAL_NS + 60 * SECOND_NS


def test_a_baseline_that_stays_is_confirmed_now_and_then_so_it_is_never_called_old(
    bench: Bench,
) -> None:
    assert bench.look(bench.frames(300.0), by_hand()).tare is None
    found = bench.look(bench.frames(RENEWAL_NS / SECOND_NS + 1.0), by_hand())
    assert found.tare is not None
    assert "nothing has moved in 15 min" in found.reason
    assert len(followed(bench, lambda _: 0.0)) <= 6


def test_two_tares_are_a_minute_apart(bench: Bench) -> None:
    for at_s, taken in ((59.0, False), (61.0, True)):
        found = bench.look(bench.frames(at_s, 1.0), by_hand())
        assert (found.tare is not None) is taken


def test_a_baseline_is_not_moved_faster_than_a_kelvin_a_minute(bench: Bench) -> None:
    # 2 K are 0.67 kPa, which is 134 s at 0.005 kPa/s
    for at_s, taken in ((120.0, False), (160.0, True)):
        frames = bench.frames(at_s, 2 * COUNTS_PER_K, warmer_k=2.0)
        found = bench.look(frames, by_hand())
        assert (found.tare is not None) is taken
        assert found.rejection is None


# --- it tares no load away ------------------------------------------------------------------------


def test_what_the_temperature_does_not_explain_is_doubted_and_left(bench: Bench) -> None:
    frames = bench.frames(300.0, [0.0, 3.0])
    found = bench.look(frames, by_hand())
    assert found.tare is None
    assert found.rejection is not None
    assert "tile T02 reads +0.4" in found.rejection
    assert "tare by hand" in found.rejection
    assert SHIFT_MAX_KPA < 3 * COUNT_KPA


@pytest.mark.slow
@pytest.mark.parametrize("newtons_per_minute", [0.02, 0.1, 0.5, 1.0, 3.0, 10.0])
def test_of_a_load_that_builds_up_slowly_hardly_anything_is_tared_away(
    bench: Bench, newtons_per_minute: float
) -> None:
    tares = followed(bench, lambda s: min(newtons_per_minute * s / 60.0, 30.0))
    lost_kpa = tares[-1].baseline_kpa - UNLOADED_KPA
    assert (lost_kpa < TOTAL_SHIFT_MAX_KPA + 0.05).all()


@pytest.mark.parametrize("newtons", [1.0, 2.0, 4.0, 8.0])
def test_a_light_load_that_is_put_on_and_stays_is_not_tared_away(
    bench: Bench, newtons: float
) -> None:
    tares = followed(bench, lambda s: newtons if s > 100 else 0.0)
    lost_kpa = tares[-1].baseline_kpa - UNLOADED_KPA
    assert (lost_kpa < SHIFT_MAX_KPA + 0.05).all()
    if newtons >= 2.0:
        assert len(tares) == 1, "not one of them"


def test_a_load_while_it_warms_is_not_hidden_in_the_warmth(bench: Bench) -> None:
    # 1 K explains 0.34 kPa, half of it is open: 0.5 kPa more are a load
    frames = bench.frames(300.0, COUNTS_PER_K + 4.0, warmer_k=1.0)
    found = bench.look(frames, by_hand())
    assert found.tare is None
    assert found.rejection is not None


def test_many_small_steps_away_from_the_tare_by_hand_are_doubted_in_the_end(bench: Bench) -> None:
    lately = replace(by_hand(200.0, counts=2.0), source="flight")
    found = bench.look(bench.frames(300.0, 3.0), lately, by_hand())
    assert found.tare is None
    assert found.rejection is not None
    assert "against the last tare by hand" in found.rejection


def test_during_a_contact_and_just_after_it_nothing_is_tared(bench: Bench) -> None:
    frames = bench.frames(300.0, 1.0)
    short_s = (RECOVERY_NS + WINDOW_NS) / SECOND_NS
    for free_s, taken in ((0.0, False), (short_s - 0.02, False), (short_s + 0.05, True)):
        assert (bench.look(frames, by_hand(), free_s=free_s).tare is not None) is taken


def test_a_flight_before_the_last_contact_does_not_count(bench: Bench) -> None:
    # In the air, then a light touch, then something that never comes to rest.
    counts = np.zeros((500, 1))
    counts[300:400] = 30.0
    counts[400:] = 6.0 * np.sin(np.arange(100) / 2.0)[:, None]
    frames = bench.frames(1000.0, counts)
    assert bench.look(frames, by_hand(), free_s=0.9).tare is None
    assert bench.look(frames, by_hand()).tare is not None


def test_a_foot_that_moves_or_has_a_silent_tile_is_left_alone(bench: Bench) -> None:
    swinging = 8.0 * np.sin(np.arange(500) / 5.0)[:, None]
    assert bench.look(bench.frames(1000.0, swinging), by_hand()) == FlightTareResult()
    assert bench.look(bench.frames(1000.0, [0.0, np.nan]), by_hand()) == FlightTareResult()


# --- the first tare -------------------------------------------------------------------------------


def stepping(rest: float) -> np.ndarray:
    """Two steps of a second each, and `rest` counts between and after them."""
    counts = np.full((500, 1), rest)
    counts[50:150] += 40.0
    counts[250:350] += 40.0
    return counts


def test_a_foot_that_steps_is_tared_between_two_steps(bench: Bench) -> None:
    found = bench.first(bench.frames(20.0, stepping(3.0)))
    assert found.tare is not None
    assert found.tare.source == "flight"
    assert found.tare.baseline_kpa == pytest.approx([UNLOADED_KPA + 3 * COUNT_KPA] * 2, abs=0.1)
    assert "between two steps" in found.reason


def test_a_step_counts_however_seldom_the_temperature_is_read(bench: Bench) -> None:
    counts = np.zeros((500, 1))
    counts[100:120] = 40.0  # 0.2 s, of which every fourth frame reads the temperature
    frames = bench.frames(20.0, counts)
    temperature_raw = np.where(
        np.arange(500)[:, None] % 4 == 0, frames.temperature_raw, NOT_READ
    ).astype(np.uint16)
    assert bench.first(replace(frames, temperature_raw=temperature_raw)).tare is not None


@pytest.mark.parametrize("counts", [0.0, 3.0, 11.0], ids=["hangs", "stands light", "stands"])
def test_a_foot_that_never_steps_is_not_tared_unasked(bench: Bench, counts: float) -> None:
    assert bench.first(bench.frames(20.0, counts)) == FlightTareResult()


def test_a_foot_that_rests_far_from_the_bench_is_not_tared_unasked(bench: Bench) -> None:
    assert bench.first(bench.frames(20.0, stepping(13.0))) == FlightTareResult()


def test_without_a_bench_nobody_knows_what_unloaded_is(bench: Bench) -> None:
    preset = Bench(bench.info, make_paper_shape_preset())
    assert preset.first(preset.frames(20.0, stepping(0.0))) == FlightTareResult()


def test_an_outlier_is_no_step(bench: Bench) -> None:
    counts = np.zeros((500, 1))
    counts[::100] = 60.0
    assert bench.first(bench.frames(20.0, counts)) == FlightTareResult()


@pytest.mark.parametrize("weather_counts", [0.0, 10.0, -4.0])
def test_a_bare_tile_follows_the_weather_and_keeps_nobody_from_taring(
    bench: Bench, weather_counts: float
) -> None:
    frames = bench.frames(600.0, [2.0 * COUNTS_PER_K, weather_counts], warmer_k=2.0)
    found = bench.look(frames, by_hand(), bears=(True, False))
    assert found.rejection is None
    assert found.tare is not None
    assert found.tare.baseline_kpa[1] == pytest.approx(
        UNLOADED_KPA + weather_counts * COUNT_KPA, abs=0.05
    )
    assert "T01" in found.reason
    assert bench.look(frames, by_hand()).rejection is not None, "a dome would be in doubt"
