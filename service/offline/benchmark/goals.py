"""What the project has set itself to reach, and whether a measured ladder reaches it.

The goals are for a scene's whole ladder. Those of coverage are of many draws pooled; with a few,
they say little.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from service.offline.accuracy import PHASES
from service.offline.benchmark.draws import LAGS_MS
from service.offline.benchmark.figures import SceneFigures

GRF_MAE_N = {
    "rolling": {"live": 0.25, "offline": 0.18},
    "poppy": {"live": 0.25, "offline": 0.18},
    "mud": {"live": 0.5, "offline": 0.4},
}
COP_P95_M = {"live": 0.001, "offline": 0.0007}
FLIGHT_MEAN_N = 0.1
SIGMA_MID_STANCE_N = 0.25
COVERAGE = (0.93, 0.97)
COVERAGE_OF_A_PHASE = (0.90, 0.99)
COVERAGE_DRAWS = 100
"""Coverage is meant to be pooled over so many draws."""


@dataclass(frozen=True)
class Goal:
    """One figure with its goal.

    Attributes:
        mode: live or offline.
        figure: what is meant, with its unit.
        value: what was measured; NaN if nothing was.
        least: the goal's lower end; None: none.
        most: its upper end.
    """

    mode: str
    figure: str
    value: float
    least: float | None
    most: float

    @property
    def met(self) -> bool:
        """Whether the figure is where it should be; not, if it is not known."""
        low = -math.inf if self.least is None else self.least
        return low <= self.value <= self.most

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self) | {"met": self.met}


def goals_of(figures: SceneFigures) -> list[Goal]:
    """The goals of a scene with what was measured of them."""
    goals = []
    for mode in LAGS_MS:
        measured = figures.measured[mode, figures.default.label]
        medians = {name: spread.median for name, spread in measured.figures.items()}
        limits = [
            ("COP 95th percentile, mm", "cop_p95_m", 1e3, COP_P95_M[mode]),
            ("GRF in flight, magnitude of the mean, N", "flight_mean_n", 1.0, FLIGHT_MEAN_N),
            ("GRF sigma in mid-stance, N", "grf_sigma_mid_stance_n", 1.0, SIGMA_MID_STANCE_N),
        ]
        if figures.scene in GRF_MAE_N:
            most_n = GRF_MAE_N[figures.scene][mode]
            limits.insert(0, ("GRF mean absolute error, N", "grf_mae_n", 1.0, most_n))
        goals += [
            Goal(mode, title, scale * medians[name], None, scale * most)
            for title, name, scale, most in limits
        ]
        for name, covered in measured.coverage.items():
            low, high = COVERAGE_OF_A_PHASE if name in PHASES else COVERAGE
            title = f"covered by the 95 % interval, {COVERED[name]}, %"
            goals.append(Goal(mode, title, 100 * covered.share, 100 * low, 100 * high))
    return goals


COVERED = {
    "all": "GRF, all frames",
    **{phase: f"GRF, {phase.replace('_', '-')}" for phase in PHASES},
    "cop_x": "COP x",
}
"""Names of what coverage is counted of."""
