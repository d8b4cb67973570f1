"""Figures over draws: medians with ranges, pooled coverage, the Pareto front, and the goals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from service.offline.accuracy import PHASES, Accuracy, Covered
from service.offline.benchmark.draws import LAGS_MS, Drawn, Failure
from service.offline.benchmark.rungs import Rung

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
"""Number of draws for which the coverage goals are defined."""


@dataclass(frozen=True)
class Goal:
    """Measured figure with its goal.

    Attributes:
        mode: live or offline.
        figure: title of the figure, with its unit.
        value: measured value; NaN if not measured.
        least: lower limit; None: none.
        most: upper limit.
    """

    mode: str
    figure: str
    value: float
    least: float | None
    most: float

    @property
    def met(self) -> bool:
        """True if the value is within the limits; False for NaN."""
        low = -math.inf if self.least is None else self.least
        return low <= self.value <= self.most

    def as_dict(self) -> dict[str, object]:
        """Return the JSON representation."""
        return asdict(self) | {"met": self.met}


def goals_of(figures: SceneFigures) -> list[Goal]:
    """Compare a scene's figures with the goals."""
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
            if name == "after_saturation":
                continue  # reported, without a goal
            low, high = COVERAGE_OF_A_PHASE if name in PHASES else COVERAGE
            title = f"covered by the 95 % interval, {COVERED[name]}, %"
            goals.append(Goal(mode, title, 100 * covered.share, 100 * low, 100 * high))
    return goals


COVERED = {
    "all": "GRF, all frames",
    **{phase: f"GRF, {phase.replace('_', '-')}" for phase in PHASES},
    "cop_x": "COP x",
    "after_saturation": "GRF, after saturation",
}
"""Titles of the coverage figures."""


MAGNITUDES = ("flight_mean_n", "grf_bias_n")
"""Signed figures, summarized by magnitude so that draws do not cancel."""


BUDGETED = ("grf_mae_n", "cop_p95_m")
"""Figures that are compared with those of the full model set, draw by draw."""


@dataclass(frozen=True)
class Spread:
    """Median, 5th and 95th percentile and number of a figure's values over draws or repetitions."""

    median: float
    p5: float
    p95: float
    n: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Compute the percentiles of all finite values."""
        finite = [value for value in values if math.isfinite(value)]
        if not finite:
            return cls(math.nan, math.nan, math.nan, 0)
        p5, median, p95 = np.percentile(finite, [5.0, 50.0, 95.0]).tolist()
        return cls(median, p5, p95, len(finite))


@dataclass(frozen=True)
class Measured:
    """Figures of one model set in one mode.

    Attributes:
        lag_ms: look-ahead.
        ns_per_frame: CPU time over repetitions.
        figures: fields of `Accuracy` over draws; magnitudes of signed ones.
        coverage: pooled over all frames of all draws: GRF in all frames and in each of `PHASES`,
            "cop_x" and "after_saturation".
        beyond_whole: excess of `BUDGETED` over those of the full model set in the same
            draw, over draws.
    """

    lag_ms: float
    ns_per_frame: Spread
    figures: Mapping[str, Spread]
    coverage: Mapping[str, Covered]
    beyond_whole: Mapping[str, Spread]


@dataclass(frozen=True)
class SceneFigures:
    """Figures of one scene."""

    scene: str
    tiles: int
    rate_hz: float
    absent_models: tuple[str, ...]
    assumed_scale: bool
    draws: int
    """Number of draws with figures."""
    frames: Spread
    rungs: tuple[Rung, ...]
    measured: Mapping[tuple[str, str], Measured]
    """Figures by mode and label of the model set."""
    failures: tuple[Failure, ...]

    @property
    def default(self) -> Rung:
        """The scene's full model set."""
        return next(rung for rung in self.rungs if rung.is_default)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON representation."""
        return {
            "scene": self.scene,
            "tiles": self.tiles,
            "rate_hz": self.rate_hz,
            "models": list(self.default.models),
            "absent_models": list(self.absent_models),
            "absolute_scale": "assumed" if self.assumed_scale else "measured",
            "draws": self.draws,
            "frames": self.frames,
            "failures": self.failures,
            "rungs": [
                {
                    "label": rung.label,
                    "models": list(rung.models),
                    "adds": rung.adds,
                    "lacks": rung.lacks,
                    "spare": rung.spare,
                    "default": rung.is_default,
                    **{mode: self.measured[mode, rung.label] for mode in LAGS_MS},
                }
                for rung in self.rungs
            ],
        }


def measured_of(
    rungs: Sequence[Rung],
    draws: Sequence[Drawn],
    times_ns: Mapping[tuple[str, str], Sequence[float]],
) -> dict[tuple[str, str], Measured]:
    """Summarize every model set in every mode, by mode and label."""
    measured = {}
    whole = next(rung for rung in rungs if rung.is_default)
    for rung in rungs:
        for mode, lag_ms in LAGS_MS.items():
            key = mode, rung.label
            judged = [d.accuracy[key] for d in draws if key in d.accuracy]
            both = [
                (d.accuracy[key], d.accuracy[mode, whole.label])
                for d in draws
                if key in d.accuracy and (mode, whole.label) in d.accuracy
            ]
            measured[key] = Measured(
                lag_ms,
                Spread.of(times_ns.get(key, ())),
                figures_of(judged),
                coverage_of(judged),
                {
                    name: Spread.of([getattr(a, name) - getattr(b, name) for a, b in both])
                    for name in BUDGETED
                },
            )
    return measured


def figures_of(judged: Sequence[Accuracy]) -> dict[str, Spread]:
    """Summarize every numeric field of `Accuracy` over draws."""
    names = [f.name for f in fields(Accuracy) if f.type in ("float", "int")]
    figures = {}
    for name in names:
        values = [float(getattr(a, name)) for a in judged]
        figures[name] = Spread.of([abs(v) for v in values] if name in MAGNITUDES else values)
    return figures


def coverage_of(judged: Sequence[Accuracy]) -> dict[str, Covered]:
    """Pool the coverage of the 95 % interval over the frames of all draws."""
    nothing = Covered(0, 0)
    phases = {phase: sum((a.grf_phases[phase] for a in judged), nothing) for phase in PHASES}
    return {
        "all": sum(phases.values(), nothing),
        **phases,
        "cop_x": sum((a.cop_covered for a in judged), nothing),
        "after_saturation": sum((a.after_saturation for a in judged), nothing),
    }


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the Pareto front, by rising first coordinate.

    A point is dominated by one that is no worse in both coordinates and better in one. Points that
    are not finite are left out.
    """
    order = sorted(
        (i for i, point in enumerate(points) if all(map(math.isfinite, point))),
        key=lambda i: points[i],
    )
    front: list[int] = []
    for i in order:
        if not front or points[i][1] < points[front[-1]][1]:
            front.append(i)
    return front
