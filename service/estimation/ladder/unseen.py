"""What a tile may have borne while it was not seen, and what that leaves in gas and rubber.

Unseen is a load behind the chip's end or beyond the calibrated range, and a stretch of more than
`UNSEEN_NS` without a reading. Models that remember are then run twice: on the best guess, and on
the load that is farthest from it of all that may have been. The second run decays towards the first
with the models' own times, and how far they are apart is what the next estimates do not know.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.compiled import compiled
from service.estimation.foot import UNSEEN_NS
from service.estimation.models.gas import Gas
from service.estimation.models.static import StaticCurves
from service.estimation.records import Record, Records, record_type, records

MOST = 2.0
"""A load beyond what a tile can tell is at most so many times the load where that ends. The paper's
dome ends at 25 to 35 N and its leg weighs 8.9 N: this is six to eight legs on a single tile. An
assumption; where loads are greater the dome is the wrong one (`foottile domes`)."""
EVENLY = 1.0 / 3.0**0.5
"""Standard uncertainty of a guess, in units of the farthest that it may be off: all between is as
likely. 1.96 of it reach a little farther than that."""


LAW = record_type(
    [
        (name, np.float64)
        for name in (
            *("high_kpa", "end_n", "slope_n_per_kpa", "most_n"),
            *("end_hot_kpa", "most_hot_kpa"),
        )
    ]
)
"""Constants of a tile, as in `Unseen`."""


@dataclass(frozen=True)
class Unseen:
    """What tiles may bear unseen, over the bearing tiles.

    Attributes:
        high_kpa: gauge pressure at the calibrated range's end.
        end_n: load there.
        slope_n_per_kpa: along which the curve is taken to go on beyond it.
        most_n: greatest load beyond what the tile can tell.
        end_hot_kpa: absolute pressure of the load at the range's end, put on too fast for its gas
            to cool.
        most_hot_kpa: likewise of the greatest load.
    """

    high_kpa: Floats
    end_n: Floats
    slope_n_per_kpa: Floats
    most_n: Floats
    end_hot_kpa: Floats
    most_hot_kpa: Floats

    def laws(self) -> Records:
        """The constants, tile by tile."""
        return records(LAW, len(self.end_n), **vars(self))


@compiled
def guess_n(law: Record, curve_n: float, gauge_kpa: float) -> float:
    """Load at a pressure that may be beyond the range, at most the greatest; NaN stays NaN.

    Args:
        law: constants of the tile.
        curve_n: force by the static curve, which stays where it ends.
        gauge_kpa: pressure above the baseline.
    """
    beyond_kpa = gauge_kpa - law.high_kpa
    guess = curve_n + law.slope_n_per_kpa * beyond_kpa if beyond_kpa > 0.0 else curve_n
    most_n: float = law.most_n
    return most_n if guess > most_n else guess


def make_unseen(
    curves: StaticCurves, gas: Gas | None, baseline_kpa: Floats, chip_end_kpa: Floats
) -> Unseen:
    """Work out what tiles may bear unseen.

    Args:
        curves: of the bearing tiles.
        gas: of them; None: it is not modelled.
        baseline_kpa: absolute pressure unloaded.
        chip_end_kpa: absolute pressure up to which the chip tells it.
    """
    at_end = curves.force(curves.high_kpa[None])
    end_n, slope = at_end.force_n[0], at_end.slope_n_per_kpa[0]
    # A preset's curve may bend over where it ends.
    slope = np.where(slope > 0.0, slope, end_n / curves.high_kpa)
    tells_kpa = np.maximum(curves.high_kpa, chip_end_kpa - baseline_kpa)
    most_n = MOST * (end_n + slope * (tells_kpa - curves.high_kpa))
    most_kpa = curves.high_kpa + (most_n - end_n) / slope
    gamma = np.ones(len(end_n)) if gas is None else gas.gamma
    # Of a plan that waits for its tare the baseline is nothing.
    base_kpa = np.maximum(baseline_kpa, 1.0)
    end_hot_kpa, most_hot_kpa = (
        base_kpa * (1.0 + gauge_kpa / base_kpa) ** gamma
        for gauge_kpa in (curves.high_kpa, most_kpa)
    )
    return Unseen(curves.high_kpa, end_n, slope, most_n, end_hot_kpa, most_hot_kpa)


@compiled
def farthest(of: float, least: float, most: float) -> float:
    """Whichever of two is farther."""
    return most if most - of > of - least else least


@compiled
def was_away(t_ns: int, last_ns: int) -> bool:
    """Does a tile give a reading after a stretch of more than `UNSEEN_NS` without?"""
    return t_ns - last_ns > UNSEEN_NS
