"""The lamp's code in the brightness of a film: offset and drift, with an honest uncertainty."""

from __future__ import annotations

import numpy as np
import pytest

from devices.arrays import Floats
from devices.errors import FileFormatError
from devices.lamp_code import BIT_NS, CODE_BITS, is_lamp_on, make_code
from service.video.alignment import fit_alignment
from service.video.light import compute_mean_code, find_lamp
from storage.sessions.videos import DRIFT_SIGMA, Alignment

SESSION_S = 120.0


def make_brightness(
    rate_hz: float, exposure: float, generator: np.random.Generator, *, dropped: float = 0.0
) -> tuple[Floats, Floats, float, float]:
    """Times and brightness of 12 parts of a film, and its true offset and drift."""
    times_s = np.arange(int(rate_hz * 20.0)) / rate_hz
    keep = generator.random(len(times_s)) >= dropped
    keep[0] = True
    times_s = times_s[keep]
    offset_ns = generator.uniform(0.0, (SESSION_S - 20.0) * 1e9)
    drift = generator.normal(0.0, DRIFT_SIGMA)
    true_ns = offset_ns + 1e9 * times_s * (1.0 + drift)
    brightness = generator.normal(100.0, 1.0, (len(times_s), 12))
    brightness[:, 5] += 25.0 * compute_mean_code(true_ns, exposure * 1e9 / rate_hz)
    return times_s, np.round(brightness), offset_ns, drift


def align(times_s: Floats, brightness: Floats) -> Alignment:
    pairs = find_lamp(times_s, brightness, 0.0, SESSION_S * 1e9)
    film_s, t_ns, sigma_ns, _ = map(np.array, zip(*pairs, strict=True))
    return fit_alignment("light", film_s, t_ns, sigma_ns, begin_t_ns=0)


def test_each_bit_of_the_code_is_half_of_the_time_on_and_no_window_comes_twice() -> None:
    code = make_code()
    assert int(code.sum()) == (CODE_BITS + 1) // 2
    numbers = np.zeros(CODE_BITS, dtype=np.int64)
    for k in range(20):
        numbers = 2 * numbers + np.roll(code, -k)
    assert len(np.unique(numbers)) == CODE_BITS
    assert [is_lamp_on((CODE_BITS + k) * BIT_NS + 1) for k in range(40)] == code[:40].tolist()
    middles_ns: Floats = np.linspace(0.5, 39.5, 40) * BIT_NS
    assert compute_mean_code(middles_ns, 1e6) == pytest.approx(code[:40], abs=1e-6)


@pytest.mark.slow(parts=4)
@pytest.mark.parametrize(
    ("rate_hz", "exposure", "dropped"),
    [(30.0, 0.3, 0.0), (50.0, 1.0, 0.05), (50.0, 0.1, 0.0), (240.0, 0.5, 0.05), (1000.0, 0.9, 0.0)],
)
def test_an_instant_is_found_within_half_a_picture_as_surely_as_it_says(
    rate_hz: float, exposure: float, dropped: float
) -> None:
    generator = np.random.default_rng(round(rate_hz + 10 * exposure))
    ratios = []
    for _ in range(4):
        times_s, brightness, offset_ns, drift = make_brightness(
            rate_hz, exposure, generator, dropped=dropped
        )
        found = align(times_s, brightness)
        middle_s = np.array([10.0])
        true_ns = offset_ns + 1e10 * (1.0 + drift)
        off_ns = float(found.t_ns + found.to_session_ns(middle_s)[0] - true_ns)
        assert abs(off_ns) < 0.5e9 / rate_hz
        ratios.append(off_ns / found.compute_sigma_ns(middle_s)[0])
    assert np.abs(ratios).max() < 4.0
    assert np.sqrt(np.mean(np.square(ratios))) < 2.5


@pytest.mark.slow(parts=8)
def test_the_uncertainty_by_light_is_that_of_many_films() -> None:
    ratios, drifts = [], []
    for rate_hz, exposure in ((30.0, 0.3), (50.0, 0.1), (50.0, 1.0)):
        generator = np.random.default_rng(round(rate_hz + 10 * exposure))
        for _ in range(50):
            times_s, brightness, offset_ns, drift = make_brightness(rate_hz, exposure, generator)
            found = align(times_s, brightness)
            true_ns = offset_ns + 1e10 * (1.0 + drift)
            off_ns = float(found.t_ns + found.to_session_ns(np.array([10.0]))[0] - true_ns)
            assert abs(off_ns) < 0.5e9 / rate_hz
            ratios.append(off_ns / found.compute_sigma_ns(np.array([10.0]))[0])
            drifts.append((found.drift - drift) / found.sigma_drift)
    for each in (ratios, drifts):
        assert 0.90 <= np.mean(np.abs(each) < 1.96) <= 0.99


def test_a_film_without_the_lamp_has_no_pair() -> None:
    generator = np.random.default_rng(5)
    times_s, brightness, _, _ = make_brightness(50.0, 0.3, generator)
    others = np.delete(brightness, 5, axis=1)
    assert find_lamp(times_s, others, 0.0, SESSION_S * 1e9) == []
    constant = np.full((len(times_s), 3), 80.0)
    assert find_lamp(times_s, constant, 0.0, SESSION_S * 1e9) == []


def test_motion_in_the_picture_is_no_lamp_in_a_long_session() -> None:
    generator = np.random.default_rng(6)
    times_s = np.arange(300) / 50.0
    kernel = np.exp(-0.5 * (2.0 * np.pi * 2.0 * np.arange(-60, 61) / 50.0) ** 2)
    motion = [np.convolve(generator.normal(0.0, 1.0, 420), kernel, "valid") for _ in range(200)]
    assert find_lamp(times_s, 100.0 + 20.0 * np.array(motion).T, 0.0, 3600e9) == []


def test_a_wrong_pair_is_left_out_and_two_that_contradict_are_refused() -> None:
    film_s = np.array([1.0, 5.0, 9.0, 14.0])
    t_ns = 1e9 * film_s * (1.0 + 20e-6) + 7e9
    t_ns[1] += 4e8
    sigma_ns = np.full(4, 1e6)
    found = fit_alignment("contact", film_s, t_ns, sigma_ns, begin_t_ns=10**18)
    assert (found.pair_count, found.rejected_count) == (3, 1)
    assert found.t_ns + found.to_session_ns(np.array([0.0]))[0] == pytest.approx(
        10**18 + 7e9, abs=2e6
    )
    with pytest.raises(FileFormatError, match="no majority"):
        fit_alignment("contact", film_s[:2], t_ns[:2], sigma_ns[:2], begin_t_ns=10**18)
    with pytest.raises(FileFormatError, match="no instant"):
        fit_alignment("light", film_s[:0], t_ns[:0], sigma_ns[:0], begin_t_ns=10**18)


def test_both_directions_of_an_alignment_are_inverse() -> None:
    found = fit_alignment(
        "hand", np.array([2.0, 8.0]), np.array([1e9, 7e9 + 2e5]), np.full(2, 1e5), begin_t_ns=5
    )
    film_s = np.linspace(-3.0, 20.0, 7)
    np.testing.assert_allclose(found.to_film_s(found.to_session_ns(film_s)), film_s, atol=1e-9)
    assert np.all(np.diff(found.compute_sigma_ns(np.array([5.0, 8.0, 100.0]))) > 0)
