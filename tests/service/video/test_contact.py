"""Touchdowns in drawn tracks of a marker: each is found, as exactly as it says."""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats
from service.video.contact import find_touchdowns

SECONDS = 2.4
_PX_PER_M = 2000.0


def draw_marker_height(
    rate_hz: float, noise_px: float, generator: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """Times and heights of a hopping foot's marker, and the true touchdowns.

    On touchdown the fall ends exponentially, then the foot rolls.
    """
    fine_s = np.arange(0.0, SECONDS + 0.6, 1e-4)
    height_m, level_m, touchdowns_s = np.zeros_like(fine_s), 0.0, []
    now_s, stop_s = generator.uniform(0.1, 0.3), generator.uniform(5e-4, 8e-3)
    while now_s < SECONDS:
        flight_s, stance_s = generator.uniform(0.2, 0.35), generator.uniform(0.25, 0.5)
        speed_m_s = 9.81 * flight_s / 2.0
        x_s = fine_s[fine_s >= now_s] - now_s
        height_m[fine_s >= now_s] = level_m + speed_m_s * x_s - 9.81 / 2.0 * x_s**2
        now_s += flight_s
        touchdowns_s.append(now_s)
        x_s = fine_s[fine_s >= now_s] - now_s
        stopped_m = speed_m_s * stop_s * (1.0 - np.exp(-x_s / stop_s))
        height_m[fine_s >= now_s] = level_m - stopped_m + generator.normal(0.0, 0.03) * x_s
        now_s += stance_s
        level_m = float(np.interp(now_s, fine_s, height_m))
    film_s = np.arange(round(SECONDS * rate_hz)) / rate_hz
    phase_s = generator.uniform() / rate_hz
    blurred_m = np.mean(
        [np.interp(film_s + phase_s + k * 0.06 / rate_hz, fine_s, height_m) for k in range(-2, 3)],
        axis=0,
    )
    noisy_px = _PX_PER_M * blurred_m + generator.normal(0.0, noise_px, len(film_s))
    return film_s, noisy_px, np.array(touchdowns_s) - phase_s


def test_each_touchdown_of_50_tracks_is_found_within_a_picture_as_surely_as_it_says() -> None:
    generator = np.random.default_rng(4)
    ratios, off_pictures = [], []
    for draw in range(50):
        rate_hz = (30.0, 50.0, 100.0, 240.0, 1000.0)[draw % 5]
        noise_px = (0.1, 0.3, 0.8)[draw % 3]
        film_s, height_px, true_s = draw_marker_height(rate_hz, noise_px, generator)
        hidden_s = generator.uniform(0.0, SECONDS)
        height_px[(film_s > hidden_s) & (film_s < hidden_s + 0.15)] = np.nan
        found = find_touchdowns(film_s, height_px)
        nearest = np.array([np.abs(true_s - one.film_s).argmin() for one in found], dtype=int)
        assert len(set(nearest.tolist())) == len(found)
        for one, k in zip(found, nearest, strict=True):
            off_pictures.append((one.film_s - true_s[k]) * rate_hz)
            ratios.append((one.film_s - true_s[k]) / one.sigma_s)
        # Missed are only those in the dark, and at the film's ends.
        for k in set(range(len(true_s))) - set(nearest.tolist()):
            at_s = true_s[k]
            near_end = not 0.25 < at_s < SECONDS - 0.2
            assert near_end or hidden_s - 0.25 < at_s < hidden_s + 0.45
    assert len(ratios) > 100
    assert np.abs(off_pictures).max() < 1.0
    assert 0.9 <= np.mean(np.abs(ratios) < 1.96) <= 0.995
    assert np.sqrt(np.mean(np.square(ratios))) < 1.2


def test_a_foot_that_hangs_or_stands_has_no_touchdown() -> None:
    generator = np.random.default_rng(2)
    film_s = np.arange(200) / 50.0
    noise_px = generator.normal(0.0, 0.3, 200)
    assert find_touchdowns(film_s, noise_px) == []
    assert find_touchdowns(film_s, 100.0 * np.sin(2.0 * np.pi * 0.5 * film_s) + noise_px) == []
    assert find_touchdowns(film_s, np.full(200, np.nan)) == []
    assert find_touchdowns(film_s[:5], noise_px[:5]) == []
