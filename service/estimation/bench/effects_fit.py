"""What a bench recording determines of a tile beside its static curve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from devices.arrays import Floats
from service.estimation.bench.identify import identify
from service.estimation.bench.indentation import Indentation, pressed_in, soak, unloaded
from service.estimation.bench.press import Presses, joined, presses
from service.estimation.bench.soak import fit_soak
from service.estimation.calibration import TileCalibration, is_monotonic
from service.estimation.effects import Effects, TemperatureEffect

_U_OF_X = np.array([[0.5, 0.5, 0.375], [0.0, 0.25, 0.375], [0.0, 0.0, 0.125]])
"""Takes a cubic in x = gauge / range without constant term to u = 2 x - 1, as far as it varies."""


def fit_effects(recordings: Sequence[Indentation], tile: TileCalibration) -> Effects:
    """Gas, rubber, hysteresis and temperature, as far as the recordings determine them.

    Args:
        recordings: of the tile on the bench, all on one chip.
        tile: its static curve, from the same recordings.
    """
    points, baseline_kpa = loadings(recordings)
    noise_kpa = float(np.mean([unloaded(each).noise_kpa for each in pressed_in(recordings)]))
    soaked = _best([fit_soak(soak(recording, noise_kpa)) for recording in recordings])
    effects = identify(
        points,
        scale_kpa=tile.range_kpa[1],
        baseline_kpa=baseline_kpa,
        first_curve=curve_over_range(tile.coefficients),
        soaked=soaked,
    )
    rubber = effects.rubber
    if rubber is None:
        return effects
    curve = _U_OF_X @ np.array(rubber.coefficients[1:])
    polynomial = (0.0, float(curve[0]), float(curve[1]), float(curve[2]))
    if not is_monotonic(polynomial, (-1.0, 1.0)):
        reason = "the curve of forces that have lasted is not monotonic"
        return effects.model_copy(
            update={"rubber": None, "refused": {**effects.refused, "rubber": reason}}
        )
    covariance = _U_OF_X @ np.array(rubber.covariance) @ _U_OF_X.T
    in_u = rubber.model_copy(
        update={
            "coefficients": polynomial,
            "covariance": tuple(map(tuple, covariance.tolist())),
        }
    )
    return effects.model_copy(update={"rubber": in_u})


def loadings(recordings: Sequence[Indentation]) -> tuple[Presses, float]:
    """Every loading of a tile above one common baseline in kPa, and that baseline."""
    recordings = pressed_in(recordings)
    zeros = [unloaded(recording) for recording in recordings]
    baseline_kpa = float(np.mean([zero.baseline_kpa for zero in zeros]))
    parts = []
    for recording, zero in zip(recordings, zeros, strict=True):
        part = presses(recording, zero)
        parts.append(replace(part, kpa=part.kpa - (zero.baseline_kpa - baseline_kpa)))
    return joined(parts), baseline_kpa


def curve_over_range(coefficients: Sequence[float]) -> Floats:
    """c1, c2, c3 over x = gauge / range of a curve whose variable is centred in that range."""
    return np.asarray(np.linalg.solve(_U_OF_X, np.array(coefficients[1:])))


def _best(soaks: Sequence[TemperatureEffect | str]) -> TemperatureEffect | str:
    """The soak that tells the rise with temperature best; without any, the last one's reason."""
    told = [warm for warm in soaks if isinstance(warm, TemperatureEffect)]
    return min(told, key=lambda warm: warm.kpa_per_k.sigma) if told else soaks[-1]
