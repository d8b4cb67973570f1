"""What a bench recording determines of a tile beside its static curve."""

from __future__ import annotations

import numpy as np

from service.estimation.bench_press import presses
from service.estimation.calibration import TileCalibration, is_monotonic
from service.estimation.effects import Effects, TemperatureEffect
from service.estimation.identify import identify
from service.estimation.indentation import Indentation, soak, unloaded
from service.estimation.soak import fit_soak

_U_OF_X = np.array([[0.5, 0.5, 0.375], [0.0, 0.25, 0.375], [0.0, 0.0, 0.125]])
"""Takes a cubic in x = gauge / range without constant term to u = 2 x - 1, as far as it varies."""


def fit_effects(recording: Indentation, tile: TileCalibration) -> Effects:
    """Gas, rubber, hysteresis and temperature, as far as the recording determines them.

    Args:
        recording: of the tile on the bench.
        tile: its static curve, from the same recording.
    """
    zero = unloaded(recording)
    warm = fit_soak(soak(recording, zero))
    effects = identify(
        presses(recording, zero),
        scale_kpa=tile.range_kpa[1],
        baseline_kpa=zero.baseline_kpa,
        first_curve=np.linalg.solve(_U_OF_X, np.array(tile.coefficients[1:])),
        temperature=warm if isinstance(warm, TemperatureEffect) else None,
        why_no_temperature="" if isinstance(warm, TemperatureEffect) else warm,
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
            "covariance": tuple(tuple(float(c) for c in row) for row in covariance),
        }
    )
    return effects.model_copy(update={"rubber": in_u})
