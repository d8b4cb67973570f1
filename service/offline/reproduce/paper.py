"""What is known here of the paper's results, and by which place in it; nothing else is compared.

PAPER is Ruppert and Badri-Sproewitz 2020 (hardware.md 0). Its figures are not reproduced here: of
most of them only what its text says is known.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Floats

CITED = (
    "Ruppert and Badri-Spröwitz, *FootTile: a Rugged Foot Sensor for Force and Center of Pressure "
    "Sensing in Soft Terrain*, 2020, arXiv 2005.09025"
)
R2 = 0.9999
"""Of the cubic, equation 2. It fits a mean over loadings: single ones differ by more."""
REPEATABILITY = 0.03
"""Standard deviation of the normalised output between loadings (III-A)."""
RANGE_N = (25.0, 35.0)
"""Of the 11 mm dome of Vytaflex 60 (III-A); of no other dome."""
LOADINGS = 4
GRF_N = 1.0
"""Mean error of the GRF, below (III)."""
COP_M = 0.004
"""Error of the COP, below (III)."""
RATE_HZ = 330.0
"""Of four tiles (II-C)."""
LEG_N = 8.92

_EQUATION_2 = (0.1309, 0.5702, 0.02354, 0.13)


def equation_2(output: Floats) -> Floats:
    """The paper's curve in normalised variables: 0 at no output, 1 at the greatest.

    Its units are not published (hardware.md 7): only the shape is compared.
    """
    curve = np.polynomial.Polynomial(_EQUATION_2)
    return np.asarray((curve(output) - curve(0.0)) / (curve(1.0) - curve(0.0)))
