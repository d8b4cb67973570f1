"""Alignment of a reference with our force: lag, drift, offset and scale, with intervals.

Cross-correlation finds a coarse lag; robust least squares then fits all four parameters under
ever narrower windows. The loss is pseudo-Huber, so landings count less, where plate and foot ring
differently. The residual is `ours - scale (reference - offset)`: noise of the regressor would bias
the scale low, and the reference is the less noisy of the two. Intervals are those of `blocks`. If
our foot states its uncertainty, they include errors that repeat in every stance: as if all of that
uncertainty had one sign, and by the differences between phases of the load.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.special import fdtri

from devices.arrays import Floats, Ints
from devices.errors import ComparisonError
from service.offline.compare.blocks import (
    Estimate,
    Spread,
    memory_of,
    over_phases,
    spread_of,
)
from service.offline.compare.lags import Peak, Peaks, likely_lags
from service.offline.compare.signals import Even, Signal, smooth

ROBUST = 1.345
"""Huber's tuning constant: beyond so many standard deviations a residual counts less."""
WIDTHS_S = (0.04, 0.01)
"""Window widths of the first fits, in s; the sample rate limits the last width."""
WIDTH_STEPS = 2.0
"""Width of the last window, in steps of the slower signal: a narrower one fits single samples."""
STEPS_A_WIDTH = 32.0
"""Largest number of steps per window width, for a signal much faster than the other."""
DRIFT_MAX = 0.01
"""Upper bound of a reference clock's relative drift, which limits the part that can overlap."""
SAMPLES_MIN = 16
"""Least number of samples, a window width apart, to fit four parameters."""
CORRELATION_MIN = 0.5
"""Least correlation at the best lag for two signals of the same load."""
RIVAL_FROM = 0.8
"""Least correlation of a rival lag, relative to the best lag's."""
CHANCE = 1e-3
"""Significance level at which an F test rejects a rival lag."""
LOADED = 0.1
"""Force above which residual noise is estimated, relative to the greatest force."""

_LAG, _DRIFT, _OFFSET, _SCALE = range(4)


@dataclass(frozen=True)
class Ambiguity:
    """Second-best lag that fits nearly as well.

    Attributes:
        lag_s: its value.
        correlation: coefficient at this lag.
        best_correlation: coefficient at the chosen lag.
    """

    lag_s: float
    correlation: float
    best_correlation: float


@dataclass(frozen=True)
class Alignment:
    """Clock and scale of a reference relative to ours: our time `t` is its `reference_s(t)`.

    Attributes:
        lag_s: reference time minus our time of the same event, at `at_s`.
        drift_ppm: rate of change of the lag, microseconds per second.
        offset_n: reference reading at zero force of ours, by the fit.
        scale: our force per reference force, N/N.
        at_s: our time at the middle of the overlap.
        covariance: (2, 2), of lag and drift, in s and 1; without our foot's repeating error, which
            the sigma of our force contains already.
        residual_n: root mean square of the residuals under the last window.
        blocks: number of time blocks behind the uncertainties.
        ambiguity: a rival lag; None if no other lag fits nearly as well.
    """

    lag_s: Estimate
    drift_ppm: Estimate
    offset_n: Estimate
    scale: Estimate
    at_s: float
    covariance: Floats
    residual_n: float
    blocks: int
    ambiguity: Ambiguity | None

    def reference_s(self, t_s: Floats) -> Floats:
        """Convert our times to reference times, (n,)."""
        drift = self.drift_ppm.value * 1e-6
        return np.asarray(t_s + self.lag_s.value + drift * (t_s - self.at_s))

    def lag_sigma_s(self, t_s: Floats) -> Floats:
        """Compute the standard error of the lag at our times, (n,)."""
        since = np.stack([np.ones(len(t_s)), t_s - self.at_s])
        variance = np.einsum("in,ij,jn->n", since, self.covariance, since)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def align(
    ours: Signal, reference: Signal, *, lag_range_s: tuple[float, float] | None = None
) -> Alignment:
    """Align a reference with our force.

    Args:
        ours: our GRF.
        reference: the reference's vertical force, on its own clock.
        lag_range_s: smallest and largest allowed lag, where several would fit; None: any.

    Raises:
        ComparisonError: a signal is constant, the two do not overlap or correlate, the reference's
            sign is wrong, or two lags fit equally well.
    """
    for signal, whose in ((ours, "our GRF"), (reference, "the reference's force")):
        _check_varies(signal, whose)
    peaks = likely_lags(ours, reference, lag_range_s)
    if peaks is None:
        raise ComparisonError(
            f"the reference and the session do not overlap{_within(lag_range_s)}",
            expected="at least half of the shorter one within the other, with a load in it",
            remedy=_elsewhere(ours, reference, lag_range_s),
        )
    _check_alike(peaks, ours, reference, lag_range_s)
    best = _fit(ours, reference, peaks.best, peaks.step_s)
    rival = peaks.rival
    ambiguity = None
    if rival is not None and rival.correlation > RIVAL_FROM * peaks.best.correlation:
        other = _fit(ours, reference, rival, peaks.step_s)
        best, other = sorted((best, other), key=lambda fit: fit.residual_n)
        if not _is_worse(other, best):
            raise ComparisonError(
                f"two lags fit equally well: {best.x[_LAG]:.4f} s and {other.x[_LAG]:.4f} s",
                expected="a load that does not repeat itself exactly",
                remedy="Name the lags that can be with --lag-range-s, or begin with a step or a "
                "tap that comes once",
            )
        known = {True: peaks.best.correlation, False: rival.correlation}
        is_first = abs(best.x[_LAG] - peaks.best.lag_s) < abs(best.x[_LAG] - rival.lag_s)
        ambiguity = Ambiguity(float(other.x[_LAG]), known[not is_first], known[is_first])
    spread = best.spread(ours)
    if best.x[_SCALE] <= 0.0:
        raise _wrong_sign()
    # The fit's drift is the lag's change over half of what overlaps.
    covariance = spread.covariance[:2, :2] / np.outer(*2 * (np.array([1.0, best.half_s]),))
    return Alignment(
        lag_s=spread.estimate(best.x, _LAG),
        drift_ppm=spread.estimate(best.x, _DRIFT).times(1e6 / best.half_s),
        offset_n=spread.estimate(best.x, _OFFSET),
        scale=spread.estimate(best.x, _SCALE),
        at_s=best.at_s,
        covariance=covariance,
        residual_n=best.residual_n,
        blocks=spread.blocks,
        ambiguity=ambiguity,
    )


def _check_varies(signal: Signal, whose: str) -> None:
    if len(signal.t_s) < 2:
        raise ComparisonError(f"{whose} has {len(signal.t_s)} samples", expected="at least two")
    height_n = float(np.ptp(signal.force_n))
    noise_n = _deviation(np.diff(signal.force_n)) / np.sqrt(2.0)
    # With many samples, noise alone spans some five sigma to either side.
    if not height_n > 12.0 * noise_n or height_n == 0.0:
        raise ComparisonError(
            f"{whose} is constant but for noise: {height_n:.3g} N from least to greatest",
            expected="a varying load",
        )


def _check_alike(
    peaks: Peaks, ours: Signal, reference: Signal, lag_range_s: tuple[float, float] | None
) -> None:
    if peaks.opposite > max(CORRELATION_MIN, peaks.best.correlation):
        raise _wrong_sign(_elsewhere(ours, reference, lag_range_s))
    if peaks.best.correlation >= CORRELATION_MIN:
        return
    raise ComparisonError(
        "the reference and our GRF do not resemble each other: correlation "
        f"{peaks.best.correlation:.2f} at the best lag{_within(lag_range_s)}",
        expected=f"at least {CORRELATION_MIN:g}: the same load, of the same foot",
        remedy=_elsewhere(ours, reference, lag_range_s),
    )


def _within(lag_range_s: tuple[float, float] | None) -> str:
    if lag_range_s is None:
        return ""
    return f" from {lag_range_s[0]:g} to {lag_range_s[1]:g} s (--lag-range-s)"


def _elsewhere(ours: Signal, reference: Signal, lag_range_s: tuple[float, float] | None) -> str:
    """Describe the best lag outside the allowed range; empty if none correlates."""
    anywhere = None if lag_range_s is None else likely_lags(ours, reference, None)
    if anywhere is None or anywhere.best.correlation < CORRELATION_MIN:
        return ""
    return (
        f"Without --lag-range-s {anywhere.best.lag_s:.2f} s fits best, with correlation "
        f"{anywhere.best.correlation:.2f}"
    )


def _wrong_sign(elsewhere: str = "") -> ComparisonError:
    return ComparisonError(
        "the reference's force falls where ours rises: its sign is turned",
        expected="the force of the ground on the foot, positive under load",
        remedy="Give the other --sign; or it is the other foot's"
        + (f". {elsewhere}" if elsewhere else ""),
    )


@dataclass(frozen=True)
class _Fit:
    """Fitted parameters and residuals, at even steps of our time."""

    x: Floats
    residual: Floats
    jacobian: Floats
    bend_n: float
    t_s: Floats
    samples: Ints
    at_s: float
    half_s: float

    @property
    def residual_n(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))

    def spread(self, ours: Signal) -> Spread:
        """Compute the parameters' uncertainty, with that stated for our force."""
        ratio = 1.0 + (self.residual / self.bend_n) ** 2
        score, curvature = self.residual / np.sqrt(ratio), ratio**-1.5
        spread = spread_of(self.jacobian, score, curvature, self.samples)
        if ours.sigma_n is None:
            return spread
        pulled = (self.jacobian * curvature[:, None]).T
        sigma_n = np.interp(self.t_s, ours.t_s, ours.sigma_n)
        one_way = np.linalg.pinv(pulled @ self.jacobian, hermitian=True) @ (pulled @ sigma_n)
        by_phase = over_phases(self.jacobian, score, curvature, -self.jacobian[:, _SCALE])
        return replace(spread, own=by_phase + np.outer(one_way, one_way))


def _fit(ours: Signal, reference: Signal, peak: Peak, coarse_s: float) -> _Fit:
    last_s = WIDTH_STEPS * max(ours.step_s, reference.step_s)
    lag_s, drift = peak.lag_s, 0.0
    fit: _Fit | None = None
    for width_s in (*(width for width in WIDTHS_S if width > last_s), last_s, last_s):
        margin_s = max(width_s, coarse_s)
        # A much faster signal need not keep all its samples.
        step_s = max(min(ours.step_s, reference.step_s), width_s / STEPS_A_WIDTH)
        step_s = min(0.5 * width_s, step_s)
        begin_s, end_s = (float(ours.t_s[i] + lag_s) for i in (0, -1))
        room_s = 10.0 * (width_s + margin_s) + DRIFT_MAX * (end_s - begin_s)
        within_s = (begin_s - room_s, end_s + room_s)
        own = smooth(ours, width_s, step_s)
        theirs = smooth(reference, width_s, step_s, margin_s, within_s)
        every = max(1, round(width_s / step_s))
        t_s, samples = own.t_s[::every], np.arange(len(own.t_s[::every]))
        to_s = t_s + lag_s + (drift * (t_s - fit.at_s) if fit is not None else 0.0)
        used = own.known[::every] & theirs.known_at(to_s)
        if used.sum() < SAMPLES_MIN:
            if width_s > last_s:  # too wide for a recording of one stance
                continue
            both = reference.known_at(ours.t_s + lag_s)
            raise ComparisonError(
                f"reference and session overlap in {both.sum() * ours.step_s:.2f} s: "
                f"{used.sum()} samples, {1e3 * width_s:.3g} ms apart, without a gap near them",
                expected=f"at least {SAMPLES_MIN}, as of one stance at 100 Hz",
            )
        fit = _fit_under(
            own.force_n[::every][used], theirs, t_s[used], samples[used], to_s[used], lag_s
        )
        lag_s, drift = float(fit.x[_LAG]), float(fit.x[_DRIFT] / fit.half_s)
    assert fit is not None  # noqa: S101  # there are two windows at least
    return fit


def _fit_under(
    own_n: Floats, theirs: Even, t_s: Floats, samples: Ints, to_s: Floats, lag_s: float
) -> _Fit:
    at_s, half_s = 0.5 * float(t_s[0] + t_s[-1]), 0.5 * float(t_s[-1] - t_s[0])
    spline = CubicSpline(theirs.t_s, theirs.force_n)
    slope = spline.derivative()
    since = (t_s - at_s) / half_s

    def instants(x: Floats) -> Floats:
        return np.asarray(t_s + x[_LAG] + x[_DRIFT] * since)

    def residual(x: Floats) -> Floats:
        return np.asarray(own_n - x[_SCALE] * (spline(instants(x)) - x[_OFFSET]))

    def jacobian(x: Floats) -> Floats:
        to = instants(x)
        rate = -x[_SCALE] * slope(to)
        offset = np.full(len(t_s), x[_SCALE])
        return np.stack([rate, rate * since, offset, x[_OFFSET] - spline(to)], axis=1)

    # The same drift as before about the new middle of what overlaps.
    drift = np.polynomial.polynomial.polyfit(since, to_s - t_s, 1)
    scale, zero_n = np.polyfit(spline(to_s), own_n, 1)
    begin = np.array([drift[0], drift[1], -zero_n / scale, scale])
    bend_n = ROBUST * _noise_n(residual(begin), own_n)
    for _ in range(2):
        found = least_squares(
            residual, begin, jacobian, loss="soft_l1", f_scale=bend_n, x_scale="jac", xtol=1e-12
        )
        begin = found.x
        bend_n = ROBUST * _noise_n(residual(begin), own_n)
    return _Fit(begin, residual(begin), jacobian(begin), bend_n, t_s, samples, at_s, half_s)


def _noise_n(residual: Floats, own_n: Floats) -> float:
    """Estimate the standard deviation of residuals under load, robust to outliers."""
    loaded = own_n - np.median(own_n[own_n <= np.median(own_n)]) > LOADED * np.ptp(own_n)
    noise_n = _deviation(residual[loaded] if loaded.sum() > 1 else residual)
    return max(noise_n, _deviation(residual), 1e-6 * float(np.ptp(own_n)))


def _deviation(values: Floats) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def _is_worse(other: _Fit, best: _Fit) -> bool:
    """Return whether a fit is significantly worse than another, by an F test of the residuals.

    Degrees of freedom count correlation times of the residuals, not samples.
    """
    left, more = best.residual, other.residual
    free, free_of_best = (max(1.0, len(one) / memory_of(one)) for one in (more, left))
    limit = float(fdtri(free, free_of_best, 1.0 - CHANCE))
    return bool(np.mean(more**2) > limit * np.mean(left**2))
