"""What warmth does to an unloaded tile, from the end of a bench recording: a soak at two warmths.

A sealed bubble at rest follows p/T of its gas, less what its wall gives way. The gas follows its
chip with one lag, and `tadc` tells the chip's temperature (hardware.md 1.3, 9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from devices.arrays import Floats
from devices.chips.mpl115a2 import TADC_PER_KELVIN, indicative_degc
from service.estimation.effects import Parameter, TemperatureEffect
from service.estimation.fitting.confidence import fit_covariance

STEP_MIN_K = 1.0
_LAG_S = (0.3, 30.0)  # shortest and longest lag that is looked for
_BIN_S = 0.1  # shorter than the shortest lag, and long enough to average noise
_SIGMA_MAX = 0.1  # relative: a baseline per kelvin that is known worse is not used
_KELVIN = 273.15
_T_SIGMA = 5.0 / 298.0
"""The chip's thermometer is not calibrated: it may be off by 5 K (hardware.md 1.3)."""
_RECOVERS_S = 5.0
"""How long a dome that was pressed before creeps back, and is left alone."""


@dataclass(frozen=True)
class Soak:
    """An unloaded tile while its surroundings warm up; arrays of n readings.

    Attributes:
        t_s: instants.
        kpa: absolute pressures, NaN where there is none.
        tadc: temperature in counts, NaN where there is none.
        noise_kpa: standard deviation of a reading.
    """

    t_s: Floats
    kpa: Floats
    tadc: Floats
    noise_kpa: float


def fit_soak(soak: Soak) -> TemperatureEffect | str:
    """How a tile's baseline follows temperature, or why the recording does not show it."""
    binned = _binned(soak)
    if binned is None:
        return "the recording has no soak at two temperatures"
    t_s, kpa, tadc, sigma_kpa = binned
    # From the mean of the first second on: a single count of noise would stay for a lag.
    chip_k = (tadc - tadc[t_s < t_s[0] + 1.0].mean()) / TADC_PER_KELVIN
    if np.ptp(chip_k) < STEP_MIN_K:
        return f"temperature changes by {np.ptp(chip_k):.1f} K only, {STEP_MIN_K} K are needed"
    step_s = float(np.median(np.diff(t_s)))

    def residual(x: Floats) -> Floats:
        base_kpa, kpa_per_k, ln_lag = x
        # Exact for a chip whose temperature is linear between the means.
        h = step_s / np.exp(ln_lag)
        decay, mean = np.exp(-h), -np.expm1(-h) / h
        gas_k, _ = lfilter([1.0 - mean, mean - decay], [1.0, -decay], chip_k, zi=[0.0])
        return np.asarray((base_kpa + kpa_per_k * gas_k - kpa) / sigma_kpa)

    low, high = np.log(_LAG_S)
    least, most = np.array([0.0, -2.0, low]), np.array([200.0, 2.0, high])
    found = least_squares(
        residual,
        [float(kpa[0]), 0.3, np.log(3.0)],
        bounds=(least, most),
        x_scale=[1.0, 0.1, 1.0],
        loss="soft_l1",
    )
    # Where readings scatter more than their noise says, so do the parameters.
    covariance = fit_covariance(found.jac, (most - least) / np.sqrt(12.0))
    sigma = np.sqrt(np.diag(covariance)) * max(1.0, np.sqrt(np.mean(found.fun**2)))
    base_kpa, kpa_per_k, ln_lag = (float(x) for x in found.x)
    if not kpa_per_k > 0.0 or sigma[1] > _SIGMA_MAX * kpa_per_k:
        return f"baseline per kelvin is {kpa_per_k:.3f} +- {sigma[1]:.3f} kPa: not determined"
    lag_s = float(np.exp(ln_lag))
    # A rigid bubble would follow p/T; what is missing is the wall's give, dp/dT = p/T/(1 + c p).
    rigid = base_kpa / (indicative_degc(float(tadc[0])) + _KELVIN)
    wall = max(0.0, (rigid / kpa_per_k - 1.0) / base_kpa)
    return TemperatureEffect(
        kpa_per_k=Parameter(value=kpa_per_k, sigma=float(sigma[1])),
        lag_s=Parameter(value=lag_s, sigma=lag_s * float(sigma[2])),
        wall_per_kpa=Parameter(
            value=wall,
            sigma=rigid / kpa_per_k / base_kpa * float(np.hypot(sigma[1] / kpa_per_k, _T_SIGMA)),
        ),
    )


def _binned(soak: Soak) -> tuple[Floats, Floats, Floats, Floats] | None:
    """Means over tenths of a second: instants, kPa, counts, and standard uncertainty."""
    good = np.isfinite(soak.kpa) & np.isfinite(soak.tadc)
    good &= soak.t_s >= soak.t_s[:1] + _RECOVERS_S
    if good.sum() < 100:
        return None
    t_s, kpa, tadc = soak.t_s[good], soak.kpa[good], soak.tadc[good]
    index = ((t_s - t_s[0]) / _BIN_S).astype(np.int64)
    n = np.bincount(index)
    if (n == 0).any():  # a hole: the lag's filter wants equal steps
        return None
    sums = [np.bincount(index, values) / n for values in (t_s, kpa, tadc)]
    return sums[0], sums[1], sums[2], np.asarray(soak.noise_kpa / np.sqrt(n))
