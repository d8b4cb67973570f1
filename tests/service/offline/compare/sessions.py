"""Sessions as columns: an irregular gait as our estimates have it, and a reference beside it."""

from __future__ import annotations

from typing import Any

import numpy as np

from devices.arrays import Floats
from service.offline.compare.alignment import ReferenceAlignment
from service.offline.compare.block_covariance import UncertainValue
from service.offline.compare.paired_frames import ReferenceSignals
from service.offline.compare.signals import ForceSignal

BEGAN_NS = 1_577_836_800_000_000_000
HZ = 500


def columns(force_n: Floats, hz: float = HZ, **given: Any) -> dict[str, Any]:
    """Estimates with this GRF, without error, as far as nothing else is given."""
    n = len(force_n)
    made: dict[str, Any] = {
        "seq": np.arange(n, dtype=np.uint64),
        "t_ns": BEGAN_NS + np.round(np.arange(n) * 1e9 / hz).astype(np.int64),
        "contact": (force_n > 0.5).astype(np.uint8),
        "grf_n": force_n,
        "grf_sigma_n": np.full(n, 0.1),
        "cop_x_m": np.where(force_n > 3.0, 0.01, np.nan),
        "cop_y_m": np.where(force_n > 3.0, -0.02, np.nan),
        "cop_sigma_x_m": np.full(n, 0.001),
        "cop_sigma_y_m": np.full(n, 0.001),
        "estimate_flags": np.zeros(n, dtype=np.uint16),
    }
    return made | given


def half_sines(peaks_n: list[float], hz: float = HZ) -> Floats:
    """Stances of half a second, half a second apart, one for each peak."""
    stance = np.sin(np.pi * np.arange(round(0.5 * hz)) / (0.5 * hz))
    flight = np.zeros(round(0.5 * hz))
    return np.concatenate([flight, *(np.r_[peak * stance, flight] for peak in peaks_n)])


def same_clock(lag_s: float = 0.0, lag_sigma_s: float = 0.0) -> ReferenceAlignment:
    """An alignment that is known beforehand."""
    sure = UncertainValue(0.0, 0.0, 10.0)
    return ReferenceAlignment(
        lag_s=UncertainValue(lag_s, lag_sigma_s, 10.0),
        drift_ppm=sure,
        offset_n=sure,
        scale=UncertainValue(1.0, 0.0, 10.0),
        mid_t_s=0.0,
        covariance=np.diag([lag_sigma_s**2, 0.0]),
        residual_n=0.0,
        block_count=10,
        ambiguity=None,
    )


def reference(force_n: Floats, hz: float = HZ, cop_m: Floats | None = None) -> ReferenceSignals:
    """A reference whose clock began with ours."""
    return ReferenceSignals(ForceSignal(np.arange(len(force_n)) / hz, force_n), cop_m)
