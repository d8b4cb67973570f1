"""All loadings of a tile in the rig, as one sequence of instants, forces and pressures.

Slow strokes are averaged in blocks; holds, releases and taps stay reading by reading. Outliers are
removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from devices.arrays import ArrayRecord, Bools, Floats, Ints
from service.estimation.fitting.rig.indentation import Indentation, UnloadedState
from service.estimation.models.outliers import find_outliers

BLOCK_READINGS = 10  # readings: 20 ms of a stroke that lasts seconds
_NOISE_MIN_KPA = 0.03
"""Least noise: rounding to a count."""
_RECORDING_GAP_S = 600.0
"""Time inserted between two recordings, in which the rubber recovers."""


@dataclass(frozen=True)
class LoadingPoints(ArrayRecord):
    """Points of all loadings, m in the order of time.

    Attributes:
        t_s: instants, from 0.
        force_n: reference force above its zero.
        kpa: absolute pressure; NaN without a reading.
        weight: square root of the number of readings averaged, over the noise, in 1/kPa.
        loading: number of the loading, from 0.
        is_fast: True for points of a hold, a release or a tap.
    """

    t_s: Floats
    force_n: Floats
    kpa: Floats
    weight: Floats
    loading: Ints
    is_fast: Bools

    @property
    def n_loadings(self) -> int:
        """Number of loadings."""
        return int(self.loading.max()) + 1


def extract_loading_points(recording: Indentation, zero: UnloadedState) -> LoadingPoints:
    """Reduce a recording to the points of its loadings."""
    rows = recording.is_under_indenter & np.isfinite(recording.reference_n)
    rows &= recording.phase != "soak"
    t_s = (recording.t_ns[rows] - recording.t_ns[rows][0]) * 1e-9
    force_n = recording.reference_n[rows] - zero.reference_zero_n
    phase = recording.phase[rows]
    kpa = np.where(np.isfinite(recording.kpa), recording.kpa, np.nan)[rows]
    # Less the part that the reference explains: the top of a tap is a single reading, too.
    unexplained_kpa = kpa - _compute_slope_kpa_per_n(kpa, force_n) * force_n
    kpa = np.where(
        find_outliers(unexplained_kpa[:, None], np.array([zero.noise_kpa]))[:, 0], np.nan, kpa
    )
    active = phase != "rest"
    before = np.concatenate([["rest"], phase[:-1]])
    # A loading may follow a stroke without a rest.
    begins = active & ((before == "rest") | ((phase == "load") & (before == "unload")))
    loading = np.maximum(np.cumsum(begins) - 1, 0)
    fast = np.isin(phase, ("hold", "release", "tap"))
    # The load before a hold, and all after a fast phase, belong to that loading.
    is_fast = np.zeros(int(loading[-1]) + 1, dtype=bool)
    is_fast[loading[fast]] = True
    fast = is_fast[loading]
    # A block ends when it is full, and at each change between slow and fast.
    run = np.cumsum(np.concatenate([[0], np.diff(fast.astype(np.int8)) != 0]))
    index = np.arange(len(t_s))
    first = np.searchsorted(run, run)
    number = np.where(fast, index, first + (index - first) // BLOCK_READINGS * BLOCK_READINGS)
    # One point for each instant.
    _, block = np.unique(number[np.searchsorted(t_s, t_s)], return_inverse=True)
    size = np.bincount(block)
    good = np.isfinite(kpa)
    counted = np.bincount(block, good)
    with np.errstate(invalid="ignore"):
        mean_kpa = np.bincount(block, np.where(good, kpa, 0.0)) / counted
    last = np.cumsum(size) - 1
    return LoadingPoints(
        t_s=np.bincount(block, t_s) / size,
        force_n=np.bincount(block, force_n) / size,
        kpa=mean_kpa,
        weight=np.sqrt(counted) / max(zero.noise_kpa, _NOISE_MIN_KPA),
        loading=loading[last],
        is_fast=fast[last],
    )


def _compute_slope_kpa_per_n(kpa: Floats, force_n: Floats) -> float:
    """Compute the mean slope of pressure over force; 0 without any load."""
    good = np.isfinite(kpa)
    spread_n = force_n[good] - force_n[good].mean() if good.any() else np.zeros(1)
    square = float((spread_n**2).sum())
    return float((spread_n * kpa[good]).sum()) / square if square > 0.0 else 0.0


def join_loading_points(parts: Sequence[LoadingPoints]) -> LoadingPoints:
    """Join several recordings to one sequence, far enough apart to be independent."""
    begin_s, loadings = 0.0, 0
    shifted = []
    for part in parts:
        shifted.append(replace(part, t_s=part.t_s + begin_s, loading=part.loading + loadings))
        begin_s = float(shifted[-1].t_s[-1]) + _RECORDING_GAP_S
        loadings += part.n_loadings
    return LoadingPoints.concatenate(shifted)
