"""Intervals that are true where residuals are correlated: by leaving out one block after the other.

Residuals of a force follow one another: what rubber has left, what averaging smooths, what a plate
rings by. Counting each as new would give intervals several times too narrow. Blocks of time that
are much longer than this memory are as good as independent, and how far an answer moves when one of
them is left out says how uncertain it is, whatever is in it (delete-a-group jackknife; of a robust
fit to first order, from its scores and its curvature).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from devices.arrays import Floats, Ints

BLOCKS = 20
BLOCKS_MIN = 8
MEMORIES = 5.0
"""A block is so many times longer than the residuals' memory."""
SHARED_MAX = 0.5
"""No variance is more than doubled for what blocks share."""

_UPPER_95 = 0.975


@dataclass(frozen=True)
class Estimate:
    """A number with its uncertainty.

    Attributes:
        value: it.
        sigma: standard error.
        dof: degrees of freedom of that, not whole: blocks tell unequally much.
    """

    value: float
    sigma: float
    dof: float

    @property
    def interval_95(self) -> tuple[float, float]:
        """By Student's t."""
        half = float(stdtrit(self.dof, _UPPER_95)) * self.sigma
        return self.value - half, self.value + half

    def times(self, factor: float) -> Estimate:
        """The same in another unit."""
        return Estimate(factor * self.value, abs(factor) * self.sigma, self.dof)

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {"value": self.value, "sigma": self.sigma, "interval_95": self.interval_95}


@dataclass(frozen=True)
class Spread:
    """How uncertain the parameters of a fit are.

    Attributes:
        covariance: (p, p).
        dof: (p,).
        blocks: how many there were.
    """

    covariance: Floats
    dof: Floats
    blocks: int

    def estimate(self, values: Floats, i: int) -> Estimate:
        """Of parameter number i."""
        return Estimate(float(values[i]), float(np.sqrt(self.covariance[i, i])), float(self.dof[i]))


def block_of(scores: Floats, samples: Ints, weight: Floats) -> Ints:
    """To which block of time each residual belongs: blocks that tell equally much.

    Args:
        scores: (n, p), what each residual says to each parameter; the one with the longest memory
            counts.
        samples: (n,), rising; number of the even time step at which it is.
        weight: (n,), how much each tells.

    Returns:
        (n,), from 0; there are `BLOCKS_MIN` to `BLOCKS`.
    """
    length = int(samples[-1] - samples[0]) + 1
    least = MEMORIES * max(memory_of(column) for column in scores.T)
    blocks = int(np.clip(length / least, BLOCKS_MIN, BLOCKS))
    least = min(least, length / blocks)
    told = np.cumsum(weight) / weight.sum()
    edges, begin, before = [], 0, 0.0
    for left in range(blocks, 1, -1):
        # As much as its share of what is left, and no shorter than that of the memory.
        end = int(np.searchsorted(told, before + (1.0 - before) / left)) + 1
        end = max(end, int(np.searchsorted(samples, samples[begin] + least)))
        end = min(end, int(np.searchsorted(samples, samples[-1] + 1 - least * (left - 1))))
        end = max(end, begin + 1)
        if end >= len(samples):
            break
        edges.append(end)
        begin, before = end, float(told[end - 1])
    return np.asarray(np.searchsorted(edges, np.arange(len(samples)), side="right"))


def memory_of(residual: Floats) -> float:
    """Samples over which residuals are correlated: 1 + 2 (sum of it until it is nothing)."""
    centred = residual - residual.mean()
    size = 2 * len(centred)
    power = np.fft.irfft(np.abs(np.fft.rfft(centred, size)) ** 2, size)[: len(centred)]
    if power[0] <= 0.0:
        return 1.0
    correlation = power / power[0]
    gone = np.flatnonzero(correlation <= 0.0)
    return float(1.0 + 2.0 * correlation[1 : gone[0] if len(gone) else len(correlation)].sum())


def spread_of(jacobian: Floats, score: Floats, curvature: Floats, samples: Ints) -> Spread:
    """Uncertainty of a fit at its least.

    Args:
        jacobian: (n, p), of the residuals by the parameters.
        score: (n,), derivative of half the loss by the residual: the residual in least squares.
        curvature: (n,), derivative of the score: one in least squares.
        samples: (n,), rising; number of the even time step at which each residual is.
    """
    scores = jacobian * score[:, None]
    telling = jacobian**2 * curvature[:, None]
    block = block_of(scores, samples, (telling / telling.sum(axis=0)).sum(axis=1))
    blocks = int(block.max()) + 1
    slopes = np.zeros((blocks, jacobian.shape[1]))
    np.add.at(slopes, block, scores)
    normals = np.stack(
        [
            (jacobian[block == b] * curvature[block == b, None]).T @ jacobian[block == b]
            for b in range(blocks)
        ]
    )
    whole = normals.sum(axis=0)
    inverse = np.linalg.pinv(whole, hermitian=True)
    moved = np.stack(
        [
            np.linalg.pinv(whole - normal, hermitian=True) @ slope
            for normal, slope in zip(normals, slopes, strict=True)
        ]
    )
    share = np.einsum("ij,bjk,ki->bi", inverse, normals, inverse)
    with np.errstate(divide="ignore", invalid="ignore"):
        even = share.sum(axis=0) ** 2 / (share**2).sum(axis=0)
    centred = moved - moved.mean(axis=0)
    # Blocks side by side share what residuals remember across their edge: half a memory of each.
    length = (samples[-1] - samples[0] + 1) / blocks
    shared = np.array([memory_of(column) for column in scores.T]) / (2.0 * length)
    wider = 1.0 / np.sqrt(1.0 - np.minimum(shared, SHARED_MAX))
    return Spread(
        covariance=(blocks - 1) / blocks * (centred.T @ centred) * np.outer(wider, wider),
        dof=np.clip(np.nan_to_num(even, nan=1.0), 1.0, blocks - 1.0),
        blocks=blocks,
    )


def mean_of(values: Floats, samples: Ints) -> Estimate:
    """Mean of values that are correlated in time; `samples` as for `block_of`."""
    mean = float(values.mean())
    ones = np.ones((len(values), 1))
    spread = spread_of(ones, values - mean, ones[:, 0], samples)
    return spread.estimate(np.array([mean]), 0)
