"""Temperature effect of an unloaded tile, from a thermal soak at two temperatures in the rig.

A sealed bubble at rest follows p/T of its gas, less the compliance of its wall. The gas lags its
chip by some seconds or leads it; the raw temperature is the chip's (hardware.md 1.3, 9). The gas is
computed as in an estimate (model `temperature`), so the misfit of that model is part of the lag's
uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.arrays import Bools, Floats, Ints
from service.estimation.effects import Parameter, TemperatureEffect
from service.estimation.fitting.least_squares import (
    compute_fit_covariance,
    compute_step_beyond_bound,
    minimize_squares,
)
from service.estimation.fitting.rig.indentation import ThermalSoak
from service.estimation.models.temperature import compute_gas_counts_and_rise_per_s

STEP_MIN_K = 1.0
LAG_RANGE_S = (-10.0, 30.0)
"""Range of lags: negative for a lagging chip, positive for a lagging gas."""
_LAGS_S = np.concatenate([-np.geomspace(10.0, 0.3, 8), [0.0], np.geomspace(0.3, 30.0, 10)])
"""Start values of the search, which has local minima."""
_BIN_S = 0.1  # shorter than lags that matter, and long enough to average noise
_SIGMA_MAX = 0.1  # relative: a less certain baseline per kelvin is not used
_KELVIN = 273.15
_T_SIGMA = 5.0 / 298.0
"""Relative uncertainty of the uncalibrated thermometer: 5 K (hardware.md 1.3)."""
_RECOVERS_S = 5.0
"""Time of a soak that is skipped while the dome recovers from earlier loads."""


def fit_temperature_effect(soak: ThermalSoak) -> TemperatureEffect | str:
    """Fit the temperature effect; return the reason where the recording does not determine it."""
    bins = _make_bins(soak)
    if bins is None:
        return "the recording has no soak at two temperatures"
    chip_counts, kpa, sigma_kpa = (
        bins.mean(soak.temperature_raw),
        bins.mean(soak.kpa),
        bins.sigma(soak),
    )
    still_counts = chip_counts[: round(1.0 / _BIN_S)].mean()
    counts_per_kelvin = soak.chip.counts_per_kelvin
    if (change_k := float(np.ptp(chip_counts)) / abs(counts_per_kelvin)) < STEP_MIN_K:
        return f"temperature changes by {change_k:.1f} K only, {STEP_MIN_K} K are needed"
    t_ns = np.rint(1e9 * soak.t_s).astype(np.int64)[:, None]

    def gas_k(lag_s: float) -> tuple[Floats, Floats]:
        """Return the gas' temperature above the chip's first one, and its rise in K/s."""
        counts, rise = compute_gas_counts_and_rise_per_s(
            soak.temperature_raw[:, None], t_ns, np.array([lag_s])
        )
        return (
            (bins.mean(counts[:, 0]) - still_counts) / counts_per_kelvin,
            bins.mean(rise[:, 0]) / counts_per_kelvin,
        )

    def residual(x: Floats) -> Floats:
        off = (x[0] + x[1] * gas_k(float(x[2]))[0] - kpa) / sigma_kpa
        # Spikes count less: as for a loss that grows with their size, not with its square.
        return np.asarray(off * np.sqrt(2.0 / (1.0 + np.sqrt(1.0 + off**2))))

    def straight(lag_s: float) -> Floats:
        """Fit baseline and rise for a lag."""
        design = np.stack([np.ones(len(kpa)), gas_k(lag_s)[0]], axis=1) / sigma_kpa[:, None]
        base, *_ = np.linalg.lstsq(design, kpa / sigma_kpa, rcond=None)
        return np.array([*base, lag_s])

    low, high = np.array([0.0, -2.0, LAG_RANGE_S[0]]), np.array([200.0, 2.0, LAG_RANGE_S[1]])
    starts = [np.clip(straight(float(lag_s)), low, high) for lag_s in _LAGS_S]
    start = min(starts, key=lambda x: float((residual(x) ** 2).sum()))
    known = (high - low) / np.sqrt(12.0)
    found = minimize_squares(residual, start, low, high, known)
    # Where readings scatter more than their noise says, so do the parameters.
    covariance = compute_fit_covariance(found.jacobian, known)
    wide = max(1.0, float(np.sqrt(np.mean(found.residual**2))))
    beyond = compute_step_beyond_bound(found.jacobian, found.residual, known, found.at_bound)
    sigma = np.hypot(np.sqrt(np.diag(covariance)) * wide, beyond)
    base_kpa, kpa_per_k, lag_s = (float(x) for x in found.x)
    if not kpa_per_k > 0.0 or sigma[1] > _SIGMA_MAX * kpa_per_k:
        return f"baseline per kelvin is {kpa_per_k:.3f} +- {sigma[1]:.3f} kPa: not determined"
    # Residual beyond noise while the temperature changes, as seconds of a lag.
    expected_k, rise_k = gas_k(lag_s)
    left = (base_kpa + kpa_per_k * expected_k - kpa) ** 2 - sigma_kpa**2
    wrong_s = np.sqrt(max(0.0, float(left.sum())) / float(((kpa_per_k * rise_k) ** 2).sum()))
    # A rigid bubble would follow p/T; the wall's compliance c lowers it: dp/dT = p/T/(1 + c p).
    rigid = base_kpa / (soak.chip.estimate_degc(float(chip_counts[0])) + _KELVIN)
    wall = (rigid / kpa_per_k - 1.0) / base_kpa
    wall_sigma = rigid / kpa_per_k / base_kpa * float(np.hypot(sigma[1] / kpa_per_k, _T_SIGMA))
    return TemperatureEffect(
        kpa_per_k=Parameter(value=kpa_per_k, sigma=float(sigma[1])),
        lag_s=Parameter(value=lag_s, sigma=float(np.hypot(sigma[2], wrong_s))),
        wall_per_kpa=Parameter(
            value=max(0.0, wall), sigma=float(np.hypot(wall_sigma, min(0.0, wall)))
        ),
    )


def list_parameters_at_bound(effect: TemperatureEffect | None) -> tuple[str, ...]:
    """Return the names of parameters at a bound."""
    if effect is None:
        return ()
    found = (("lag_s", effect.lag_s, LAG_RANGE_S), ("wall_per_kpa", effect.wall_per_kpa, (0.0,)))
    return tuple(name for name, parameter, ends in found if parameter.value in ends)


@dataclass(frozen=True)
class _Bins:
    """Bins of a tenth of a second with valid readings; none is empty."""

    good: Bools
    index: Ints
    count: Ints

    def mean(self, values: Floats) -> Floats:
        return np.asarray(np.bincount(self.index, values[self.good]) / self.count)

    def sigma(self, soak: ThermalSoak) -> Floats:
        return np.asarray(soak.noise_kpa / np.sqrt(self.count))


def _make_bins(soak: ThermalSoak) -> _Bins | None:
    good = np.isfinite(soak.kpa) & np.isfinite(soak.temperature_raw)
    good &= soak.t_s >= soak.t_s[:1] + _RECOVERS_S
    if good.sum() < 100:
        return None
    t_s = soak.t_s[good]
    index = ((t_s - t_s[0]) / _BIN_S).astype(np.int64)
    count = np.bincount(index)
    # The temperature in a hole is unknown.
    return None if (count == 0).any() else _Bins(good, index, count)
