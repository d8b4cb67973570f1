"""Alignment of a reference with our force: lag, drift, offset and scale, with intervals.

Cross-correlation finds a coarse lag; robust least squares then fits all four parameters under ever
narrower windows. The loss is pseudo-Huber, so landings count less, where plate and foot ring
differently. The residual is `ours - scale (reference - offset)`: noise of the regressor would bias
the scale low, and the reference is the less noisy of the two. Intervals are those of
`block_covariance`. If our foot states its uncertainty, they include errors that repeat in every
stance: as if all of that uncertainty had one sign, and by the differences between phases of the
load.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.special import fdtri

from devices.arrays import Floats, Ints
from devices.errors import ComparisonError
from service.offline.compare.block_covariance import (
    FitUncertainty,
    UncertainValue,
    compute_fit_uncertainty,
    compute_phase_covariance,
    estimate_correlation_samples,
)
from service.offline.compare.signals import (
    CorrelationPeak,
    EvenSignal,
    ForceSignal,
    LagCandidates,
    compute_robust_deviation,
    find_lag_candidates,
    low_pass,
)

HUBER_SIGMAS = 1.345
"""Huber's tuning constant: beyond so many standard deviations a residual counts less."""
COARSE_WIDTHS_S = (0.04, 0.01)
"""Window widths of the first fits, in s; the sample rate limits the last width."""
LAST_WIDTH_STEPS = 2.0
"""Width of the last window, in steps of the slower signal: a narrower one fits single samples."""
MAX_STEPS_PER_WIDTH = 32.0
"""Largest number of steps per window width, for a signal much faster than the other."""
MAX_DRIFT = 0.01
"""Upper bound of a reference clock's relative drift, which limits the part that can overlap."""
MIN_SAMPLES = 16
"""Least number of samples, a window width apart, to fit four parameters."""
MIN_CORRELATION = 0.5
"""Least correlation at the best lag for two signals of the same load."""
MIN_RIVAL_CORRELATION = 0.8
"""Least correlation of a rival lag, relative to the best lag's."""
RIVAL_SIGNIFICANCE = 1e-3
"""Significance level at which an F test rejects a rival lag."""
LOADED_SHARE = 0.1
"""Force above which residual noise is estimated, relative to the greatest force."""

_LAG, _DRIFT, _OFFSET, _SCALE = range(4)


@dataclass(frozen=True)
class RivalLag:
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
class ReferenceAlignment:
    """Clock and scale of a reference relative to ours: our time `t` is its `reference_s(t)`.

    Attributes:
        lag_s: reference time minus our time of the same event, at `mid_t_s`.
        drift_ppm: rate of change of the lag, microseconds per second.
        offset_n: reference reading at zero force of ours, by the fit.
        scale: our force per reference force, N/N.
        mid_t_s: our time at the middle of the overlap.
        covariance: (2, 2), of lag and drift, in s and 1; without our foot's repeating error, which
            the sigma of our force contains already.
        residual_n: root mean square of the residuals under the last window.
        block_count: number of time blocks behind the uncertainties.
        ambiguity: a rival lag; None if no other lag fits nearly as well.
    """

    lag_s: UncertainValue
    drift_ppm: UncertainValue
    offset_n: UncertainValue
    scale: UncertainValue
    mid_t_s: float
    covariance: Floats
    residual_n: float
    block_count: int
    ambiguity: RivalLag | None

    def to_reference_time_s(self, t_s: Floats) -> Floats:
        """Convert our times to reference times, (n,)."""
        drift = self.drift_ppm.value * 1e-6
        return np.asarray(t_s + self.lag_s.value + drift * (t_s - self.mid_t_s))

    def compute_lag_sigma_s(self, t_s: Floats) -> Floats:
        """Compute the standard error of the lag at our times, (n,)."""
        since = np.stack([np.ones(len(t_s)), t_s - self.mid_t_s])
        variance = np.einsum("in,ij,jn->n", since, self.covariance, since)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def align_signals(
    ours: ForceSignal, reference: ForceSignal, *, lag_range_s: tuple[float, float] | None = None
) -> ReferenceAlignment:
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
    peaks = find_lag_candidates(ours, reference, lag_range_s)
    if peaks is None:
        raise ComparisonError(
            f"the reference and the session do not overlap{_describe_lag_range(lag_range_s)}",
            expected="at least half of the shorter one within the other, with a load in it",
            remedy=_describe_excluded_lag(ours, reference, lag_range_s),
        )
    _check_correlation(peaks, ours, reference, lag_range_s)
    best, ambiguity = _fit_best_lag(ours, reference, peaks)
    spread = best.compute_uncertainty(ours)
    if best.parameters[_SCALE] <= 0.0:
        raise _make_sign_error()
    # The fit's drift is the lag's change over half of what overlaps.
    covariance = spread.covariance[:2, :2] / np.outer(*2 * (np.array([1.0, best.half_duration_s]),))
    return ReferenceAlignment(
        lag_s=spread.get_parameter(best.parameters, _LAG),
        drift_ppm=spread.get_parameter(best.parameters, _DRIFT).scale_by(
            1e6 / best.half_duration_s
        ),
        offset_n=spread.get_parameter(best.parameters, _OFFSET),
        scale=spread.get_parameter(best.parameters, _SCALE),
        mid_t_s=best.mid_t_s,
        covariance=covariance,
        residual_n=best.residual_n,
        block_count=spread.block_count,
        ambiguity=ambiguity,
    )


def _fit_best_lag(
    ours: ForceSignal, reference: ForceSignal, peaks: LagCandidates
) -> tuple[_Fit, RivalLag | None]:
    """Fit the best lag; with it return a rival that correlates nearly as well, if there is one.

    Raises:
        ComparisonError: the rival fits equally well.
    """
    best, rival = _fit_around_peak(ours, reference, peaks.best, peaks.step_s), peaks.rival
    if rival is None or not rival.correlation > MIN_RIVAL_CORRELATION * peaks.best.correlation:
        return best, None
    other = _fit_around_peak(ours, reference, rival, peaks.step_s)
    best, other = sorted((best, other), key=lambda fit: fit.residual_n)
    lag_s, other_s = (float(fit.parameters[_LAG]) for fit in (best, other))
    if not _is_worse(other, best):
        raise ComparisonError(
            f"two lags fit equally well: {lag_s:.4f} s and {other_s:.4f} s",
            expected="a load that does not repeat itself exactly",
            remedy="Name the lags that can be with --lag-range-s, or begin with a step or a "
            "tap that comes once",
        )
    correlations = (rival.correlation, peaks.best.correlation)
    if abs(lag_s - peaks.best.lag_s) >= abs(lag_s - rival.lag_s):
        correlations = correlations[::-1]
    return best, RivalLag(other_s, *correlations)


def _check_varies(signal: ForceSignal, whose: str) -> None:
    if len(signal.t_s) < 2:
        raise ComparisonError(f"{whose} has {len(signal.t_s)} samples", expected="at least two")
    height_n = float(np.ptp(signal.force_n))
    noise_n = compute_robust_deviation(np.diff(signal.force_n)) / np.sqrt(2.0)
    # With many samples, noise alone spans some five sigma to either side.
    if not height_n > 12.0 * noise_n or height_n == 0.0:
        raise ComparisonError(
            f"{whose} is constant but for noise: {height_n:.3g} N from least to greatest",
            expected="a varying load",
        )


def _check_correlation(
    peaks: LagCandidates,
    ours: ForceSignal,
    reference: ForceSignal,
    lag_range_s: tuple[float, float] | None,
) -> None:
    if peaks.inverted_correlation > max(MIN_CORRELATION, peaks.best.correlation):
        raise _make_sign_error(_describe_excluded_lag(ours, reference, lag_range_s))
    if peaks.best.correlation >= MIN_CORRELATION:
        return
    raise ComparisonError(
        "the reference and our GRF do not resemble each other: correlation "
        f"{peaks.best.correlation:.2f} at the best lag{_describe_lag_range(lag_range_s)}",
        expected=f"at least {MIN_CORRELATION:g}: the same load, of the same foot",
        remedy=_describe_excluded_lag(ours, reference, lag_range_s),
    )


def _describe_lag_range(lag_range_s: tuple[float, float] | None) -> str:
    if lag_range_s is None:
        return ""
    return f" from {lag_range_s[0]:g} to {lag_range_s[1]:g} s (--lag-range-s)"


def _describe_excluded_lag(
    ours: ForceSignal, reference: ForceSignal, lag_range_s: tuple[float, float] | None
) -> str:
    """Describe the best lag outside the allowed range; empty if none correlates."""
    anywhere = None if lag_range_s is None else find_lag_candidates(ours, reference, None)
    if anywhere is None or anywhere.best.correlation < MIN_CORRELATION:
        return ""
    return (
        f"Without --lag-range-s {anywhere.best.lag_s:.2f} s fits best, with correlation "
        f"{anywhere.best.correlation:.2f}"
    )


def _make_sign_error(elsewhere: str = "") -> ComparisonError:
    return ComparisonError(
        "the reference's force falls where ours rises: its sign is turned",
        expected="the force of the ground on the foot, positive under load",
        remedy="Give the other --sign; or it is the other foot's"
        + (f". {elsewhere}" if elsewhere else ""),
    )


@dataclass(frozen=True)
class _Fit:
    """Fitted parameters and residuals, at even steps of our time."""

    parameters: Floats
    residual: Floats
    jacobian: Floats
    huber_threshold_n: float
    t_s: Floats
    samples: Ints
    mid_t_s: float
    half_duration_s: float

    @property
    def residual_n(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))

    def compute_uncertainty(self, ours: ForceSignal) -> FitUncertainty:
        """Compute the parameters' uncertainty, with that stated for our force."""
        ratio = 1.0 + (self.residual / self.huber_threshold_n) ** 2
        score, curvature = self.residual / np.sqrt(ratio), ratio**-1.5
        spread = compute_fit_uncertainty(self.jacobian, score, curvature, self.samples)
        if ours.sigma_n is None:
            return spread
        pulled = (self.jacobian * curvature[:, None]).T
        sigma_n = np.interp(self.t_s, ours.t_s, ours.sigma_n)
        one_way = np.linalg.pinv(pulled @ self.jacobian, hermitian=True) @ (pulled @ sigma_n)
        by_phase = compute_phase_covariance(
            self.jacobian, score, curvature, -self.jacobian[:, _SCALE]
        )
        return replace(spread, repeating_covariance=by_phase + np.outer(one_way, one_way))


def _fit_around_peak(
    ours: ForceSignal, reference: ForceSignal, peak: CorrelationPeak, coarse_s: float
) -> _Fit:
    last_s = LAST_WIDTH_STEPS * max(ours.step_s, reference.step_s)
    lag_s, drift = peak.lag_s, 0.0
    fit: _Fit | None = None
    for width_s in (*(width for width in COARSE_WIDTHS_S if width > last_s), last_s, last_s):
        margin_s = max(width_s, coarse_s)
        # A much faster signal need not keep all its samples.
        step_s = max(min(ours.step_s, reference.step_s), width_s / MAX_STEPS_PER_WIDTH)
        step_s = min(0.5 * width_s, step_s)
        begin_s, end_s = (float(ours.t_s[i] + lag_s) for i in (0, -1))
        room_s = 10.0 * (width_s + margin_s) + MAX_DRIFT * (end_s - begin_s)
        within_s = (begin_s - room_s, end_s + room_s)
        own = low_pass(ours, width_s, step_s)
        theirs = low_pass(reference, width_s, step_s, margin_s, within_s)
        every = max(1, round(width_s / step_s))
        t_s, samples = own.t_s[::every], np.arange(len(own.t_s[::every]))
        to_s = t_s + lag_s + (drift * (t_s - fit.mid_t_s) if fit is not None else 0.0)
        used = own.is_known[::every] & theirs.has_known_sample(to_s)
        if used.sum() < MIN_SAMPLES:
            if width_s > last_s:  # too wide for a recording of one stance
                continue
            both = reference.is_known(ours.t_s + lag_s)
            raise ComparisonError(
                f"reference and session overlap in {both.sum() * ours.step_s:.2f} s: "
                f"{used.sum()} samples, {1e3 * width_s:.3g} ms apart, without a gap near them",
                expected=f"at least {MIN_SAMPLES}, as of one stance at 100 Hz",
            )
        fit = _fit_window(own.force_n[::every][used], theirs, t_s[used], samples[used], to_s[used])
        lag_s, drift = (
            float(fit.parameters[_LAG]),
            float(fit.parameters[_DRIFT] / fit.half_duration_s),
        )
    assert fit is not None  # noqa: S101  # there are two windows at least
    return fit


def _fit_window(
    own_n: Floats, theirs: EvenSignal, t_s: Floats, samples: Ints, to_s: Floats
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
    bend_n = HUBER_SIGMAS * _estimate_noise_n(residual(begin), own_n)
    for _ in range(2):
        found = least_squares(
            residual, begin, jacobian, loss="soft_l1", f_scale=bend_n, x_scale="jac", xtol=1e-12
        )
        begin = found.x
        bend_n = HUBER_SIGMAS * _estimate_noise_n(residual(begin), own_n)
    return _Fit(begin, residual(begin), jacobian(begin), bend_n, t_s, samples, at_s, half_s)


def _estimate_noise_n(residual: Floats, own_n: Floats) -> float:
    """Estimate the standard deviation of residuals under load, robust to outliers."""
    loaded = own_n - np.median(own_n[own_n <= np.median(own_n)]) > LOADED_SHARE * np.ptp(own_n)
    noise_n = compute_robust_deviation(residual[loaded] if loaded.sum() > 1 else residual)
    return max(noise_n, compute_robust_deviation(residual), 1e-6 * float(np.ptp(own_n)))


def _is_worse(other: _Fit, best: _Fit) -> bool:
    """Return whether a fit is significantly worse than another, by an F test of the residuals.

    Degrees of freedom count correlation times of the residuals, not samples.
    """
    left, more = best.residual, other.residual
    free, free_of_best = (
        max(1.0, len(one) / estimate_correlation_samples(one)) for one in (more, left)
    )
    limit = float(fdtri(free, free_of_best, 1.0 - RIVAL_SIGNIFICANCE))
    return bool(np.mean(more**2) > limit * np.mean(left**2))


@dataclass(frozen=True)
class ClockLag:
    """Lag by the clock tables alone.

    Attributes:
        lag_s: as in `ReferenceAlignment`, at the same time.
        error_bound_s: bound of its error; not a standard uncertainty.
    """

    lag_s: float
    error_bound_s: float

    def as_dict(self) -> dict[str, object]:
        """Return the content that `service.json_output.to_json_value` converts."""
        return {
            "value": self.lag_s,
            "within": (self.lag_s - self.error_bound_s, self.lag_s + self.error_bound_s),
        }


def describe_clock_contradiction(
    alignment: ReferenceAlignment, clock_lag: ClockLag | None
) -> list[str]:
    """Return a note if the lag by forces contradicts the lag by clocks; else an empty list."""
    if clock_lag is None:
        return []
    low_s, high_s = alignment.lag_s.interval_95
    least_s, most_s = (
        clock_lag.lag_s - clock_lag.error_bound_s,
        clock_lag.lag_s + clock_lag.error_bound_s,
    )
    if low_s <= most_s and least_s <= high_s:
        return []
    return [
        f"the clocks say a lag of {1e3 * clock_lag.lag_s:.3f} ms, within "
        f"{1e3 * clock_lag.error_bound_s:.3f} ms, and the forces another one: two feet, or two "
        "servers' sessions"
    ]
