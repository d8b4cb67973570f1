"""Confidence intervals for correlated residuals, by cluster-robust covariance over time blocks.

Residuals of a force are correlated in time: rubber creeps, averaging smooths, a plate rings.
Treating samples as independent would give intervals several times too narrow. Blocks of time much
longer than the correlation time are nearly independent. The covariance is the sandwich estimator of
cluster-robust regression, to first order for a robust fit, from its scores and its curvature. It
corrects for the block's own influence on its residuals (CR2 of Bell and McCaffrey, Survey
Methodology 28, 2002, p. 169); the jackknife over-corrects where few blocks have most of the
information, as with three stances.

Errors of the rubber model that repeat in every stance do not differ between blocks. They show as
differences between phases of the load: `compute_phase_covariance` leaves out one of rise and fall,
each low and high, over all stances, and measures how far the estimate moves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from devices.arrays import Floats, Ints

MAX_BLOCKS = 20
MIN_BLOCKS = 8
CORRELATION_TIMES_PER_BLOCK = 5.0
"""Block length, in correlation times of the residuals."""
MAX_LEVERAGE = 0.999
"""Largest leverage of a block; beyond it, rounding errors dominate."""
MAX_EDGE_CORRELATION = 0.5
"""Largest correction for correlation across block edges: it at most doubles a variance."""

NORMAL_95 = 1.96
_UPPER_95 = 0.975


@dataclass(frozen=True)
class UncertainValue:
    """Estimated value with its uncertainty.

    Attributes:
        value: estimate.
        sigma: standard error.
        dof: its degrees of freedom, not an integer, as blocks have unequal information.
        repeating_sigma: standard uncertainty from our foot's error that repeats in every stance.
    """

    value: float
    sigma: float
    dof: float
    repeating_sigma: float = 0.0

    @property
    def interval_95(self) -> tuple[float, float]:
        """95 % interval, by Student's t; the part of our foot's repeating error is normal."""
        half = math.hypot(self._fit_half_interval, NORMAL_95 * self.repeating_sigma)
        return self.value - half, self.value + half

    @property
    def is_mostly_repeating(self) -> bool:
        """True if the interval is mostly our foot's repeating error."""
        return NORMAL_95 * self.repeating_sigma > self._fit_half_interval

    @property
    def _fit_half_interval(self) -> float:
        return float(stdtrit(self.dof, _UPPER_95)) * self.sigma

    def scale_by(self, factor: float) -> UncertainValue:
        """Return the estimate multiplied by a unit factor."""
        more = abs(factor)
        return UncertainValue(
            factor * self.value, more * self.sigma, self.dof, more * self.repeating_sigma
        )

    def as_dict(self) -> dict[str, object]:
        """Return the content that `service.json_output.to_json_value` converts."""
        return {
            "value": self.value,
            "sigma": self.sigma,
            "own_sigma": self.repeating_sigma,
            "interval_95": self.interval_95,
        }


@dataclass(frozen=True)
class FitUncertainty:
    """Uncertainty of the parameters of a fit.

    Attributes:
        covariance: (p, p).
        dof: (p,), degrees of freedom.
        block_count: number of time blocks.
        repeating_covariance: (p, p), covariance of our foot's error that repeats in every stance.
    """

    covariance: Floats
    dof: Floats
    block_count: int
    repeating_covariance: Floats

    def get_parameter(self, values: Floats, i: int) -> UncertainValue:
        """Return parameter `i` with its uncertainty."""
        sigma, own = (
            math.sqrt(matrix[i, i]) for matrix in (self.covariance, self.repeating_covariance)
        )
        return UncertainValue(float(values[i]), sigma, float(self.dof[i]), own)


def assign_blocks(scores: Floats, samples: Ints, weight: Floats) -> Ints:
    """Assign residuals to consecutive time blocks with equal information.

    Args:
        scores: (n, p), score of each residual for each parameter; the longest correlation time of
            the p columns sets the block length.
        samples: (n,), rising; index of the even time step of each residual.
        weight: (n,), information of each residual.

    Returns:
        Block index of each residual (n,), from 0; there are `MIN_BLOCKS` to `MAX_BLOCKS`.
    """
    memory = max(1.0, *(estimate_correlation_samples(column) for column in scores.T))
    # A long rest has no information: only informative time counts, as the number of correlation
    # times of equal weight (Kish's effective sample size).
    weights = np.bincount(((samples - samples[0]) / memory).astype(np.intp), weight)
    length, least = (
        memory * weights.sum() ** 2 / (weights**2).sum(),
        CORRELATION_TIMES_PER_BLOCK * memory,
    )
    blocks = int(np.clip(length / least, MIN_BLOCKS, MAX_BLOCKS))
    least = min(least, length / blocks)
    shares = np.cumsum(weight) / weight.sum()
    edges, begin, before = [], 0, 0.0
    for left in range(blocks, 1, -1):
        # Its share of the remaining information, and at least the correlation-limited length.
        end = int(np.searchsorted(shares, before + (1.0 - before) / left)) + 1
        end = max(end, int(np.searchsorted(samples, samples[begin] + least)))
        end = min(end, int(np.searchsorted(samples, samples[-1] + 1 - least * (left - 1))))
        end = max(end, begin + 1)
        if end >= len(samples):
            break
        edges.append(end)
        begin, before = end, float(shares[end - 1])
    return np.asarray(np.searchsorted(edges, np.arange(len(samples)), side="right"))


def estimate_correlation_samples(residual: Floats) -> float:
    """Estimate the correlation time in samples: 1 + 2 (sum of autocorrelation to first zero)."""
    centred = residual - residual.mean()
    size = 2 * len(centred)
    power = np.fft.irfft(np.abs(np.fft.rfft(centred, size)) ** 2, size)[: len(centred)]
    if power[0] <= 0.0:
        return 1.0
    correlation = power / power[0]
    gone = np.flatnonzero(correlation <= 0.0)
    return float(1.0 + 2.0 * correlation[1 : gone[0] if len(gone) else len(correlation)].sum())


def compute_fit_uncertainty(
    jacobian: Floats, score: Floats, curvature: Floats, samples: Ints
) -> FitUncertainty:
    """Compute the uncertainty of a fit at its minimum.

    Args:
        jacobian: (n, p), derivatives of the residuals by the parameters.
        score: (n,), derivative of half the loss by the residual: the residual in least squares.
        curvature: (n,), derivative of the score: one in least squares.
        samples: (n,), rising; index of the even time step of each residual.
    """
    scores = jacobian * score[:, None]
    telling = jacobian**2 * curvature[:, None]
    block = assign_blocks(scores, samples, (telling / telling.sum(axis=0)).sum(axis=1))
    blocks = int(block.max()) + 1
    normals, slopes = _sum_by_group(jacobian, score, curvature, block)
    whole = normals.sum(axis=0)
    inverse = np.linalg.pinv(whole, hermitian=True)
    pulls = _compute_block_influences(normals, slopes)
    share = np.einsum("ij,bjk,ki->bi", inverse, normals, inverse)
    with np.errstate(divide="ignore", invalid="ignore"):
        even = share.sum(axis=0) ** 2 / (share**2).sum(axis=0)
    # Adjacent blocks are correlated across their edge, over half a correlation time of each.
    length = (samples[-1] - samples[0] + 1) / blocks
    shared = np.array([estimate_correlation_samples(column) for column in scores.T]) / (
        2.0 * length
    )
    wider = 1.0 / np.sqrt(1.0 - np.minimum(shared, MAX_EDGE_CORRELATION))
    return FitUncertainty(
        covariance=(pulls.T @ pulls) * np.outer(wider, wider),
        dof=np.clip(np.nan_to_num(even, nan=1.0), 1.0, blocks - 1.0),
        block_count=blocks,
        repeating_covariance=np.zeros_like(whole),
    )


def compute_phase_covariance(
    jacobian: Floats, score: Floats, curvature: Floats, force_n: Floats
) -> Floats:
    """Compute the covariance of a fit by leaving out one load phase of all stances at a time.

    With four phases only, it is widened so that 1.96 of its square root is Student's interval
    with three degrees of freedom.

    Args:
        jacobian: (n, p), derivatives of the residuals by the parameters; the first one is a time.
        score: as for `compute_fit_uncertainty`.
        curvature: likewise.
        force_n: (n,), load.
    """
    rises, telling = jacobian[:, 0] < 0.0, jacobian[:, 0] ** 2 * curvature
    phase = np.zeros(len(force_n), dtype=np.intp)
    for side, of_side in enumerate((~rises, rises)):
        rows = np.flatnonzero(of_side)[np.argsort(force_n[of_side], kind="stable")]
        shares = np.cumsum(telling[rows])
        half = int(np.searchsorted(shares, 0.5 * shares[-1])) if len(shares) else 0
        phase[rows] = 2 * side + (np.arange(len(rows)) > half)
    moved = _compute_leave_one_out_shifts(*_sum_by_group(jacobian, score, curvature, phase))
    centred = moved - moved.mean(axis=0)
    free = len(moved) - 1
    wider = float(stdtrit(free, _UPPER_95)) / NORMAL_95
    return np.asarray(wider**2 * free / len(moved) * (centred.T @ centred))


def _sum_by_group(
    jacobian: Floats, score: Floats, curvature: Floats, group: Ints
) -> tuple[Floats, Floats]:
    """Compute normal matrices (g, p, p) and loss gradients (g, p) of groups numbered from 0."""
    groups = int(group.max()) + 1
    slopes = np.zeros((groups, jacobian.shape[1]))
    np.add.at(slopes, group, jacobian * score[:, None])
    normals = [
        (jacobian[group == g] * curvature[group == g, None]).T @ jacobian[group == g]
        for g in range(groups)
    ]
    return np.stack(normals), slopes


def _compute_leave_one_out_shifts(normals: Floats, slopes: Floats) -> Floats:
    """Compute how far a fit moves without each group, (g, p)."""
    whole = normals.sum(axis=0)
    return np.stack(
        [
            np.linalg.pinv(whole - normal, hermitian=True) @ slope
            for normal, slope in zip(normals, slopes, strict=True)
        ]
    )


def _compute_block_influences(normals: Floats, slopes: Floats) -> Floats:
    """Compute each block's influence on a fit, (g, p), with the CR2 correction."""
    size, axes = np.linalg.eigh(normals.sum(axis=0))
    # An undetermined parameter is reported by the fit.
    known = size > size[-1] * len(size) * np.finfo(np.float64).eps
    root = (axes[:, known] / np.sqrt(size[known])) @ axes[:, known].T
    pulls = []
    for normal, slope in zip(normals, slopes, strict=True):
        share, along = np.linalg.eigh(root @ normal @ root)
        back = along / np.sqrt(1.0 - np.minimum(share, MAX_LEVERAGE))
        pulls.append(root @ (back @ along.T) @ root @ slope)
    return np.stack(pulls)


def compute_correlated_mean(values: Floats, samples: Ints) -> UncertainValue:
    """Compute the mean of values correlated in time; `samples` as for `assign_blocks`."""
    mean = float(values.mean())
    ones = np.ones((len(values), 1))
    spread = compute_fit_uncertainty(ones, values - mean, ones[:, 0], samples)
    return spread.get_parameter(np.array([mean]), 0)
