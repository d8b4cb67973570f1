"""An unloaded pressure that goes back as rubber creeps is told from leaks, slips and warmth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.errors import CalibrationError
from service.estimation.fitting.rig.checks import (
    check_baseline_drift_between_repeats_kpa,
    fit_unloaded_recovery,
)
from service.estimation.fitting.rig.indentation import Indentation

STEP_S = 0.01
STROKES, REST_S, STROKE_S, ALONE_S = 4, 0.3, 8.0, 15.0
FULL_N, KPA_PER_N = 24.0, 0.9


def bench(extra_kpa: np.ndarray | None = None, *, alone_s: float = ALONE_S) -> Indentation:
    """Four slow strokes, then left alone; the pressure is the force's, and `extra_kpa`."""
    force_n = np.concatenate([_forces(), np.zeros(round(alone_s / STEP_S))])
    phase = np.concatenate([_phases(), np.full(round(alone_s / STEP_S), "soak")])
    extra = np.zeros(len(force_n)) if extra_kpa is None else extra_kpa[: len(force_n)]
    noise = np.random.default_rng(1).normal(0.0, 0.165, len(force_n))
    return Indentation(
        serial="T01",
        where="bench.parquet",
        t_ns=np.rint(1e9 * STEP_S * np.arange(len(force_n))).astype(np.int64),
        kpa=100.0 + KPA_PER_N * force_n + extra + noise,
        reference_n=np.where(phase == "soak", np.nan, force_n + 0.3),
        phase=phase,
        is_under_indenter=phase != "soak",
        temperature_raw=np.full(len(force_n), 498.0),
    )


def _forces() -> np.ndarray:
    rise = np.linspace(0.0, FULL_N, round(STROKE_S / 2 / STEP_S))
    return np.tile(np.concatenate([np.zeros(round(REST_S / STEP_S)), rise, rise[::-1]]), STROKES)


def _phases() -> np.ndarray:
    half = round(STROKE_S / 2 / STEP_S)
    one = ["rest"] * round(REST_S / STEP_S) + ["load"] * half + ["unload"] * half
    return np.array(one * STROKES)


def everything_n() -> np.ndarray:
    return np.concatenate([_forces(), np.zeros(round(ALONE_S / STEP_S))])


def crept_kpa(parts: tuple[float, ...], times_s: tuple[float, ...]) -> np.ndarray:
    """What creeping parts of the force are late by."""
    force_n, late_n = everything_n(), np.zeros(len(everything_n()))
    for part, tau_s in zip(parts, times_s, strict=True):
        state = 0.0
        for i, now_n in enumerate(force_n):
            state += (now_n - state) * (1.0 - np.exp(-STEP_S / tau_s))
            late_n[i] += part * (state - now_n)
    return KPA_PER_N * late_n


def leaked_kpa(leak_s: float) -> np.ndarray:
    """What a dome reads less whose gas goes out, and comes in, as fast as the pressure is high."""
    lost, out = 0.0, []
    for static_kpa in KPA_PER_N * everything_n():
        lost += (static_kpa - lost) * STEP_S / leak_s
        out.append(-lost)
    return np.array(out)


@pytest.mark.parametrize("times_s", [(9.0,), (1.3, 7.0), (0.2, 2.0, 10.0)])
def test_creep_of_up_to_15_percent_over_seconds_is_no_drift(times_s: tuple[float, ...]) -> None:
    part = 0.15 / len(times_s)
    recording = bench(crept_kpa((part,) * len(times_s), times_s))
    assert check_baseline_drift_between_repeats_kpa([recording]) < 0.8
    settled = fit_unloaded_recovery(recording)
    assert settled is not None
    assert np.ptp(settled.kpa[:STROKES]) > 0.9
    assert np.ptp(settled.residual_kpa) < 0.15


def test_that_much_creep_is_refused_where_nothing_shows_that_it_goes_back() -> None:
    kpa = crept_kpa((0.15,), (9.0,))
    for alone_s in (0.0, 4.0):
        with pytest.raises(CalibrationError, match=r"drifts by .* leave it alone for 15 s"):
            check_baseline_drift_between_repeats_kpa([bench(kpa, alone_s=alone_s)])


@pytest.mark.parametrize("leak_s", [5.0, 20.0, 100.0])
def test_a_dome_that_leaks_is_refused_although_it_breathes_in_again(leak_s: float) -> None:
    with pytest.raises(CalibrationError, match=r"creep would leave .* the dome leaks"):
        check_baseline_drift_between_repeats_kpa([bench(leaked_kpa(leak_s))])


@pytest.mark.parametrize("stroke", [0, 1, 2])
@pytest.mark.parametrize("slip_kpa", [-1.2, 1.2])
def test_a_seal_that_slipped_is_refused_because_nothing_goes_back(
    stroke: int, slip_kpa: float
) -> None:
    slipped_s = stroke * (REST_S + STROKE_S) + REST_S + STROKE_S / 2
    t_s = STEP_S * np.arange(len(everything_n()))
    with pytest.raises(CalibrationError, match=r"creep would leave"):
        check_baseline_drift_between_repeats_kpa([bench(np.where(t_s > slipped_s, slip_kpa, 0.0))])


def test_a_slip_beside_creep_is_refused() -> None:
    t_s = STEP_S * np.arange(len(everything_n()))
    kpa = crept_kpa((0.1,), (3.0,)) + np.where(t_s > 13.0, 1.0, 0.0)
    with pytest.raises(CalibrationError, match=r"creep would leave"):
        check_baseline_drift_between_repeats_kpa([bench(kpa)])


def test_a_tile_that_goes_on_warming_up_is_refused() -> None:
    t_s = STEP_S * np.arange(len(everything_n()))
    with pytest.raises(CalibrationError, match=r"creep would leave"):
        check_baseline_drift_between_repeats_kpa([bench(0.04 * t_s)])


def test_what_comes_with_a_change_of_temperature_does_not_count_as_what_the_load_left() -> None:
    kpa = crept_kpa((0.15,), (5.0,))
    t_s = STEP_S * np.arange(len(kpa))
    # The gas a second before its chip.
    warm_s = t_s[-1] - 5.0
    recording = bench(kpa + 1.2 * (t_s > warm_s - 1.0))
    warmed = replace(recording, temperature_raw=recording.temperature_raw - 20.0 * (t_s > warm_s))
    assert check_baseline_drift_between_repeats_kpa([warmed]) < 0.8
    with pytest.raises(CalibrationError, match=r"creep would leave"):
        check_baseline_drift_between_repeats_kpa([recording])


def test_a_pause_of_the_recording_under_load_is_no_load_that_explains_a_drift() -> None:
    end = len(_forces())
    at = end - round(STROKE_S / 4 / STEP_S)  # in the last way back
    t_s = STEP_S * np.arange(len(everything_n()))
    drift_kpa = np.where(np.arange(len(t_s)) >= at, 3.0 * np.exp(-(t_s - t_s[at]) / 10.0), 0.0)
    whole = bench(drift_kpa)
    later_ns = np.where(np.arange(len(t_s)) >= at, 60_000_000_000, 0)
    broken = fit_unloaded_recovery(replace(whole, t_ns=whole.t_ns + later_ns))
    unbroken = fit_unloaded_recovery(whole)
    assert broken is not None
    assert unbroken is not None
    assert np.ptp(broken.residual_kpa) > 0.8 * np.ptp(unbroken.residual_kpa)
