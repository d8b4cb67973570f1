"""Intervals that are true where residuals are correlated: by how much blocks of time differ.

Residuals of a force follow one another: what rubber has left, what averaging smooths, what a plate
rings by. Counting each as new would give intervals several times too narrow. Blocks of time that
are much longer than this memory are as good as independent, and how far each pulls an answer says
how uncertain it is, whatever is in it: the sandwich of cluster-robust regression, of a robust fit
to first order, from its scores and its curvature. What a block tells of its own residuals is put
back (CR2 of Bell and McCaffrey, Survey Methodology 28, 2002, p. 169): leaving blocks out, the
jackknife, puts back too much where few tell most, as three stances do.

What a model of rubber gets wrong in the same way in every stance, no block of time can show. It
shows where phases of the load contradict one another: how far the answer moves without one of the
rise and the fall of a load, each low and high, of all stances together (`over_phases`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from devices.arrays import Floats, Ints

BLOCKS = 20
BLOCKS_MIN = 8
MEMORIES = 5.0
"""A block is so many times longer than the residuals' memory."""
SHARE_MAX = 0.999
"""Of what a block alone tells, the rest is noise of rounding."""
SHARED_MAX = 0.5
"""No variance is more than doubled for what blocks share."""

NORMAL_95 = 1.96
_UPPER_95 = 0.975


@dataclass(frozen=True)
class Estimate:
    """A number with its uncertainty.

    Attributes:
        value: it.
        sigma: standard error.
        dof: degrees of freedom of that, not whole: blocks tell unequally much.
        own: standard uncertainty from what our foot gets wrong in the same way all the time.
    """

    value: float
    sigma: float
    dof: float
    own: float = 0.0

    @property
    def interval_95(self) -> tuple[float, float]:
        """By Student's t; for what our foot gets wrong, of which blocks do not tell, normal."""
        half = math.hypot(float(stdtrit(self.dof, _UPPER_95)) * self.sigma, NORMAL_95 * self.own)
        return self.value - half, self.value + half

    def times(self, factor: float) -> Estimate:
        """The same in another unit."""
        more = abs(factor)
        return Estimate(factor * self.value, more * self.sigma, self.dof, more * self.own)

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "value": self.value,
            "sigma": self.sigma,
            "own_sigma": self.own,
            "interval_95": self.interval_95,
        }


@dataclass(frozen=True)
class Spread:
    """How uncertain the parameters of a fit are.

    Attributes:
        covariance: (p, p).
        dof: (p,).
        blocks: how many there were.
        own: (p, p), covariance of what our foot gets wrong all the time.
    """

    covariance: Floats
    dof: Floats
    blocks: int
    own: Floats

    def estimate(self, values: Floats, i: int) -> Estimate:
        """Of parameter number i."""
        sigma, own = (math.sqrt(matrix[i, i]) for matrix in (self.covariance, self.own))
        return Estimate(float(values[i]), sigma, float(self.dof[i]), own)


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
    memory = max(1.0, *(memory_of(column) for column in scores.T))
    # In a long rest beside a few stances nothing is told: counted is the time that does tell, as
    # many memories of it as would tell as much if all told the same (Kish's effective size).
    told = np.bincount(((samples - samples[0]) / memory).astype(np.intp), weight)
    length, least = memory * told.sum() ** 2 / (told**2).sum(), MEMORIES * memory
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
    normals, slopes = _by_group(jacobian, score, curvature, block)
    whole = normals.sum(axis=0)
    inverse = np.linalg.pinv(whole, hermitian=True)
    pulls = _pulls(normals, slopes)
    share = np.einsum("ij,bjk,ki->bi", inverse, normals, inverse)
    with np.errstate(divide="ignore", invalid="ignore"):
        even = share.sum(axis=0) ** 2 / (share**2).sum(axis=0)
    # Blocks side by side share what residuals remember across their edge: half a memory of each.
    length = (samples[-1] - samples[0] + 1) / blocks
    shared = np.array([memory_of(column) for column in scores.T]) / (2.0 * length)
    wider = 1.0 / np.sqrt(1.0 - np.minimum(shared, SHARED_MAX))
    return Spread(
        covariance=(pulls.T @ pulls) * np.outer(wider, wider),
        dof=np.clip(np.nan_to_num(even, nan=1.0), 1.0, blocks - 1.0),
        blocks=blocks,
        own=np.zeros_like(whole),
    )


def over_phases(jacobian: Floats, score: Floats, curvature: Floats, force_n: Floats) -> Floats:
    """Covariance of a fit from its phases: how far it moves without one of them, in all stances.

    Four phases tell little of how much they differ: it is so much wider that 1.96 of its square
    root is Student's interval with three degrees of freedom.

    Args:
        jacobian: (n, p), of the residuals by the parameters; the first is a time.
        score: as for `spread_of`.
        curvature: likewise.
        force_n: (n,), how high the load is.
    """
    rises, telling = jacobian[:, 0] < 0.0, jacobian[:, 0] ** 2 * curvature
    phase = np.zeros(len(force_n), dtype=np.intp)
    for side, of_side in enumerate((~rises, rises)):
        rows = np.flatnonzero(of_side)[np.argsort(force_n[of_side], kind="stable")]
        told = np.cumsum(telling[rows])
        half = int(np.searchsorted(told, 0.5 * told[-1])) if len(told) else 0
        phase[rows] = 2 * side + (np.arange(len(rows)) > half)
    moved = _moved(*_by_group(jacobian, score, curvature, phase))
    centred = moved - moved.mean(axis=0)
    free = len(moved) - 1
    wider = float(stdtrit(free, _UPPER_95)) / NORMAL_95
    return np.asarray(wider**2 * free / len(moved) * (centred.T @ centred))


def _by_group(
    jacobian: Floats, score: Floats, curvature: Floats, group: Ints
) -> tuple[Floats, Floats]:
    """Normal matrices (g, p, p) and slopes of the loss (g, p) of groups from 0."""
    groups = int(group.max()) + 1
    slopes = np.zeros((groups, jacobian.shape[1]))
    np.add.at(slopes, group, jacobian * score[:, None])
    normals = [
        (jacobian[group == g] * curvature[group == g, None]).T @ jacobian[group == g]
        for g in range(groups)
    ]
    return np.stack(normals), slopes


def _moved(normals: Floats, slopes: Floats) -> Floats:
    """By how much a fit moves without each group, (g, p)."""
    whole = normals.sum(axis=0)
    return np.stack(
        [
            np.linalg.pinv(whole - normal, hermitian=True) @ slope
            for normal, slope in zip(normals, slopes, strict=True)
        ]
    )


def _pulls(normals: Floats, slopes: Floats) -> Floats:
    """By how much each block pulls a fit, (g, p), as if it had had no part in it (CR2)."""
    size, axes = np.linalg.eigh(normals.sum(axis=0))
    # Of a parameter that nothing determines nothing is known; the fit says so elsewhere.
    known = size > size[-1] * len(size) * np.finfo(np.float64).eps
    root = (axes[:, known] / np.sqrt(size[known])) @ axes[:, known].T
    pulls = []
    for normal, slope in zip(normals, slopes, strict=True):
        share, along = np.linalg.eigh(root @ normal @ root)
        back = along / np.sqrt(1.0 - np.minimum(share, SHARE_MAX))
        pulls.append(root @ (back @ along.T) @ root @ slope)
    return np.stack(pulls)


def mean_of(values: Floats, samples: Ints) -> Estimate:
    """Mean of values that are correlated in time; `samples` as for `block_of`."""
    mean = float(values.mean())
    ones = np.ones((len(values), 1))
    spread = spread_of(ones, values - mean, ones[:, 0], samples)
    return spread.estimate(np.array([mean]), 0)
