"""Results stated in the paper's text, each with its section; only these are compared.

PAPER is Ruppert and Badri-Sproewitz 2020 (hardware.md 0). The data behind most of its figures are
not available, only the values in its text.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats

CITED = (
    "Ruppert and Badri-Spröwitz, *FootTile: a Rugged Foot Sensor for Force and Center of Pressure "
    "Sensing in Soft Terrain*, 2020, arXiv 2005.09025"
)
CUBIC_R2 = 0.9999
"""R2 of the cubic, equation 2, fitted to the mean over loadings; single loadings deviate more."""
REPEATABILITY = 0.03
"""Standard deviation of the normalised output between loadings (III-A)."""
DOME_RANGE_N = (25.0, 35.0)
"""Range of the 11 mm dome of Vytaflex 60 (III-A); none is stated for other domes."""
LOADINGS = 4
MAX_GRF_ERROR_N = 1.0
"""Upper bound of the mean GRF error (III)."""
MAX_COP_ERROR_M = 0.004
"""Upper bound of the COP error (III)."""
FRAME_RATE_HZ = 330.0
"""Frame rate of four tiles (II-C)."""
LEG_WEIGHT_N = 8.92

_EQUATION_2 = (0.1309, 0.5702, 0.02354, 0.13)


def compute_normalised_force(output: Floats) -> Floats:
    """Compute the paper's curve in normalised variables: 0 without output, 1 at the greatest.

    Its units are not published (hardware.md 7): only the shape is compared.
    """
    curve = np.polynomial.Polynomial(_EQUATION_2)
    return np.asarray((curve(output) - curve(0.0)) / (curve(1.0) - curve(0.0)))
