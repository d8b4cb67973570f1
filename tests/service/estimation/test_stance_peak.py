"""Peak force of a stance: noise, shape, scale and batches."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.estimation.stances import Stance, StanceDetector, compute_stances

STEP_NS = 2_000_000
SELECTION_SIGMAS = 6.0

Floats = npt.NDArray[np.float64]
SEEDS = st.integers(0, 2**32 - 1)


def stance_frames(
    grf_n: Floats, sigma_n: Floats | float, t_ns: npt.NDArray[np.int64] | None = None
) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.int64], dict[str, npt.NDArray[Any]]]:
    """Make frames of one stance, 2 ms apart by default, without a COP."""
    n = len(grf_n)
    seq = np.arange(n, dtype=np.uint64)
    columns: dict[str, npt.NDArray[Any]] = {
        "contact": np.ones(n, np.uint8),
        "grf_n": grf_n,
        "grf_sigma_n": np.broadcast_to(np.asarray(sigma_n, np.float64), n).copy(),
        "cop_x_m": np.full(n, np.nan),
        "cop_sigma_x_m": np.full(n, np.nan),
        "estimate_flags": np.zeros(n, np.uint16),
    }
    return seq, np.arange(n, dtype=np.int64) * STEP_NS if t_ns is None else t_ns, columns


def stance(grf_n: Floats, sigma_n: Floats | float, **options: Any) -> Stance:
    """Compute the only stance of its frames."""
    (only,) = compute_stances(*stance_frames(grf_n, sigma_n, **options))
    return only


def make_half_sine_n(frames: int) -> Floats:
    """Make an impact of 30 N with its peak at a frame."""
    return np.asarray(30.0 * np.sin(np.pi * np.arange(1, frames + 1) / (frames + 1)))


def draw_stance(seed: int, frames: int = 120) -> tuple[Floats, Floats]:
    """Draw a wandering force with noise, and its sigmas."""
    rng = np.random.default_rng(seed)
    force_n = 20.0 + np.cumsum(rng.normal(0.0, 0.2, frames)) + rng.normal(0.0, 0.3, frames)
    return force_n, rng.uniform(0.2, 0.6, frames)


@pytest.mark.parametrize(
    ("truth_n", "sigma_n", "largest_bias_sigmas"),
    [
        (np.full(301, 10.0), 1.0, 0.25),  # the largest frame is 2.9 sigmas too high
        (np.full(1001, 10.0), 1.0, 0.25),
        (make_half_sine_n(15), 0.5, 0.3),
        (make_half_sine_n(61), 0.5, 0.2),
        (make_half_sine_n(501), 0.5, 0.2),
    ],
)
def test_white_noise_does_not_bias_the_peak(
    truth_n: Floats, sigma_n: float, largest_bias_sigmas: float
) -> None:
    rng = np.random.default_rng(1)
    found = [stance(truth_n + rng.normal(0, sigma_n, len(truth_n)), sigma_n) for _ in range(80)]
    errors_n = np.array([one.peak_grf_n for one in found]) - truth_n.max()
    sigmas_n = np.array([one.peak_sigma_n for one in found])
    standard_error_n = errors_n.std() / np.sqrt(len(errors_n))
    assert abs(errors_n.mean()) <= largest_bias_sigmas * sigma_n + 3 * standard_error_n
    assert np.mean(np.abs(errors_n) <= 1.96 * sigmas_n) >= 0.9


def test_an_error_shared_by_all_frames_stays_in_sigma() -> None:
    noise_n = np.random.default_rng(2).normal(0.0, 0.1, 1001)
    one = stance(10.0 + noise_n, float(np.hypot(0.1, 0.3)))
    assert one.peak_sigma_n == pytest.approx(0.3, abs=0.02)
    assert one.peak_grf_n == pytest.approx(10.0, abs=0.05)


@given(
    seed=SEEDS,
    frames=st.integers(1, 300),
    curvature=st.floats(0.0, 1e-2),
    sigma_n=st.sampled_from([0.0, 0.3, 10.0]),
)
def test_the_peak_of_a_parabola_without_noise_is_exact(
    seed: int, frames: int, curvature: float, sigma_n: float
) -> None:
    rng = np.random.default_rng(seed)
    t_ns = np.cumsum(rng.choice([STEP_NS, STEP_NS, 3 * STEP_NS // 2, 10 * STEP_NS], frames))
    apex = int(rng.integers(frames))
    grf_n = 30.0 - curvature * ((t_ns - t_ns[apex]) / STEP_NS) ** 2
    assert stance(grf_n, sigma_n, t_ns=t_ns).peak_grf_n == pytest.approx(30.0, abs=1e-9)


def test_a_spike_of_one_frame_is_a_peak() -> None:
    grf_n = 10.0 + np.random.default_rng(3).normal(0.0, 0.1, 200)
    grf_n[77] += 5.0
    one = stance(grf_n, 0.1)
    assert (one.peak_grf_n, one.peak_t_ns) == (grf_n[77], 77 * STEP_NS)


def test_an_uncertain_frame_is_no_peak() -> None:
    grf_n = 10.0 + np.random.default_rng(4).normal(0.0, 0.1, 200)
    sigma_n = np.full(200, 0.1)
    grf_n[77], sigma_n[77] = 12.0, 1.0
    assert stance(grf_n, sigma_n).peak_grf_n == pytest.approx(10.0, abs=0.2)


def test_a_large_error_of_scale_does_not_hide_a_narrow_peak() -> None:
    grf_n = np.full(400, 20.0)
    grf_n[50:65] += make_half_sine_n(15) / 6.0
    assert stance(grf_n, 0.3 * grf_n).peak_grf_n == pytest.approx(25.0, abs=0.1)


@settings(max_examples=50)
@given(seed=SEEDS)
def test_the_peak_is_within_the_noise_of_the_largest_frames(seed: int) -> None:
    force_n, sigma_n = draw_stance(seed)
    peak_n = stance(force_n, sigma_n).peak_grf_n
    assert np.max(force_n - SELECTION_SIGMAS * sigma_n) <= peak_n <= np.max(force_n + sigma_n)


@settings(max_examples=30)
@given(seed=SEEDS, exponent=st.integers(-8, 8), offset_n=st.floats(-100.0, 100.0))
def test_the_peak_scales_and_shifts_with_the_force(
    seed: int, exponent: int, offset_n: float
) -> None:
    force_n, sigma_n = draw_stance(seed)
    one, scale = stance(force_n, sigma_n), 2.0**exponent
    scaled = stance(scale * force_n, scale * sigma_n)
    assert scaled.peak_grf_n == scale * one.peak_grf_n
    assert scaled.peak_sigma_n == scale * one.peak_sigma_n
    shifted = stance(force_n + offset_n, sigma_n)
    assert shifted.peak_grf_n == pytest.approx(one.peak_grf_n + offset_n, abs=1e-9)
    assert shifted.peak_sigma_n == pytest.approx(one.peak_sigma_n, rel=1e-9)
    assert scaled.peak_t_ns == shifted.peak_t_ns == one.peak_t_ns


@settings(max_examples=30)
@given(seed=SEEDS, outside_n=st.floats(-50.0, 50.0))
def test_frames_outside_a_stance_do_not_change_its_peak(seed: int, outside_n: float) -> None:
    force_n, sigma_n = draw_stance(seed)
    contact = np.repeat([0, 1, 0], 40).astype(np.uint8)
    alone = stance(force_n[40:80], sigma_n[40:80])
    seq, t_ns, columns = stance_frames(np.where(contact, force_n, outside_n), sigma_n)
    (one,) = compute_stances(seq, t_ns, {**columns, "contact": contact})
    assert (one.peak_grf_n, one.peak_sigma_n) == (alone.peak_grf_n, alone.peak_sigma_n)


@pytest.mark.parametrize("batch", [997, 5000])
def test_the_peak_of_a_long_stance_does_not_depend_on_the_batches(batch: int) -> None:
    force_n, sigma_n = draw_stance(5, 11_000)
    seq, t_ns, columns = stance_frames(force_n, sigma_n)
    detector = StanceDetector()
    for begin in range(0, len(seq), batch):
        rows = slice(begin, begin + batch)
        detector.add_frames(seq[rows], t_ns[rows], {k: v[rows] for k, v in columns.items()})
    (one,) = detector.finish()
    whole = stance(force_n, sigma_n)
    assert (one.peak_grf_n, one.peak_t_ns) == (whole.peak_grf_n, whole.peak_t_ns)
    assert one.peak_sigma_n == whole.peak_sigma_n
