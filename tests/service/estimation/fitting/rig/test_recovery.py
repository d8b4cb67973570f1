"""Recovery of the unloaded pressure: creep, not leaks, slips or warmth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from devices.chips.mpl115a2 import MPL115A2
from devices.chips.pressure_chip import PressureChip
from devices.chips.pressure_chips import PRESSURE_CHIPS
from devices.errors import CalibrationError
from service.estimation.fitting.rig.checks import (
    check_baseline_drift_between_repeats_kpa,
    fit_unloaded_recovery,
)
from service.estimation.fitting.rig.indentation import Indentation

STEP_S = 0.01
STROKES, REST_S, STROKE_S, ALONE_S = 4, 0.3, 8.0, 15.0
FULL_N, KPA_PER_N = 24.0, 0.9
HALF, REST = round(STROKE_S / 2 / STEP_S), round(REST_S / STEP_S)
RISE_N = np.linspace(0.0, FULL_N, HALF)
STROKES_N = np.tile(np.concatenate([np.zeros(REST), RISE_N, RISE_N[::-1]]), STROKES)
PHASES = np.array((["rest"] * REST + ["load"] * HALF + ["unload"] * HALF) * STROKES)
ALL_N = np.append(STROKES_N, np.zeros(round(ALONE_S / STEP_S)))
T_S = STEP_S * np.arange(len(ALL_N))


def record(
    extra_kpa: np.ndarray | None = None, *, alone_s: float = ALONE_S, chip: PressureChip = MPL115A2
) -> Indentation:
    """Record four slow strokes, then no load; the pressure is the force's, and `extra_kpa`."""
    force_n = np.append(STROKES_N, np.zeros(round(alone_s / STEP_S)))
    phase = np.append(PHASES, np.full(round(alone_s / STEP_S), "soak"))
    extra = np.zeros(len(force_n)) if extra_kpa is None else extra_kpa[: len(force_n)]
    rng = np.random.default_rng(1)
    noise = rng.normal(0.0, 0.165, len(force_n))
    return Indentation(
        chip=chip,
        serial="T01",
        where="bench.parquet",
        t_ns=np.rint(1e9 * STEP_S * np.arange(len(force_n))).astype(np.int64),
        kpa=100.0 + KPA_PER_N * force_n + extra + noise,
        reference_n=np.where(phase == "soak", np.nan, force_n + 0.3),
        phase=phase,
        is_under_indenter=phase != "soak",
        temperature_raw=rng.normal(
            chip.temperature_raw_usual, chip.temperature_noise_counts, len(force_n)
        ),
    )


def lag(force_n: np.ndarray, tau_s: float) -> np.ndarray:
    part = 1.0 - np.exp(-STEP_S / tau_s)
    return np.asarray(lfilter([part], [1.0, part - 1.0], force_n))


def compute_creep_kpa(parts: tuple[float, ...], times_s: tuple[float, ...]) -> np.ndarray:
    """Compute the lag of creeping parts of the force."""
    pairs = zip(parts, times_s, strict=True)
    lags_n = [part * (lag(ALL_N, tau_s) - ALL_N) for part, tau_s in pairs]
    return np.asarray(KPA_PER_N * np.sum(lags_n, axis=0))


@pytest.mark.parametrize("chip", PRESSURE_CHIPS.values(), ids=PRESSURE_CHIPS)
@pytest.mark.parametrize("times_s", [(9.0,), (1.3, 7.0), (0.2, 2.0, 10.0)])
def test_creep_of_15_percent_over_seconds_is_no_drift(
    times_s: tuple[float, ...], chip: PressureChip
) -> None:
    part = 0.15 / len(times_s)
    recording = record(compute_creep_kpa((part,) * len(times_s), times_s), chip=chip)
    assert check_baseline_drift_between_repeats_kpa([recording]) < 0.8
    settled = fit_unloaded_recovery(recording)
    assert settled is not None
    assert np.ptp(settled.kpa[:STROKES]) > 0.9
    assert np.ptp(settled.residual_kpa) < 0.15


def test_creep_without_time_to_recover_is_refused() -> None:
    kpa = compute_creep_kpa((0.15,), (9.0,))
    for alone_s in (0.0, 4.0):
        with pytest.raises(CalibrationError, match=r"drifts by .* leave it alone for 15 s"):
            check_baseline_drift_between_repeats_kpa([record(kpa, alone_s=alone_s)])


@pytest.mark.parametrize("leak_s", [5.0, 20.0, 100.0])
def test_a_leak_is_refused(leak_s: float) -> None:
    with pytest.raises(CalibrationError, match=r"creep would leave .* the dome leaks"):
        check_baseline_drift_between_repeats_kpa([record(-KPA_PER_N * lag(ALL_N, leak_s))])


@pytest.mark.parametrize("stroke", [0, 1, 2])
@pytest.mark.parametrize("slip_kpa", [-1.2, 1.2])
def test_a_slipped_seal_is_refused(stroke: int, slip_kpa: float) -> None:
    slipped_s = stroke * (REST_S + STROKE_S) + REST_S + STROKE_S / 2
    with pytest.raises(CalibrationError, match=r"creep would leave"):
        check_baseline_drift_between_repeats_kpa([record(np.where(slipped_s < T_S, slip_kpa, 0.0))])


def test_a_slip_beside_creep_is_refused() -> None:
    kpa = compute_creep_kpa((0.1,), (3.0,)) + np.where(T_S > 13.0, 1.0, 0.0)
    with pytest.raises(CalibrationError, match=r"creep would leave"):
        check_baseline_drift_between_repeats_kpa([record(kpa)])


def test_a_warming_tile_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"creep would leave"):
        check_baseline_drift_between_repeats_kpa([record(0.04 * T_S)])


def test_a_shift_with_a_change_of_temperature_is_no_drift() -> None:
    kpa = compute_creep_kpa((0.15,), (5.0,))
    # The gas a second before its chip.
    warm_s = T_S[-1] - 5.0
    recording = record(kpa + 1.2 * (warm_s - 1.0 < T_S))
    warmed = replace(recording, temperature_raw=recording.temperature_raw - 20.0 * (warm_s < T_S))
    assert check_baseline_drift_between_repeats_kpa([warmed]) < 0.8
    with pytest.raises(CalibrationError, match=r"creep would leave"):
        check_baseline_drift_between_repeats_kpa([recording])


def test_a_pause_of_the_recording_explains_no_drift() -> None:
    at = len(STROKES_N) - round(STROKE_S / 4 / STEP_S)  # in the last way back
    drift_kpa = np.where(np.arange(len(T_S)) >= at, 3.0 * np.exp(-(T_S - T_S[at]) / 10.0), 0.0)
    whole = record(drift_kpa)
    later_ns = np.where(np.arange(len(T_S)) >= at, 60_000_000_000, 0)
    broken = fit_unloaded_recovery(replace(whole, t_ns=whole.t_ns + later_ns))
    unbroken = fit_unloaded_recovery(whole)
    assert broken is not None
    assert unbroken is not None
    assert np.ptp(broken.residual_kpa) > 0.8 * np.ptp(unbroken.residual_kpa)
