"""Figures over draws: medians with ranges, pooled coverage, the Pareto front, and the goals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from service.offline.accuracy import PHASES, Accuracy, CoverageCount
from studies.benchmark.draws import LAGS_MS, ComparedModelSet, DrawResult, MeasurementFailure

GRF_MAE_GOALS_N = {
    "rolling": {"live": 0.25, "offline": 0.18},
    "poppy": {"live": 0.25, "offline": 0.18},
    "mud": {"live": 0.5, "offline": 0.4},
}
COP_P95_GOALS_M = {"live": 0.001, "offline": 0.0007}
FLIGHT_MEAN_GOAL_N = 0.1
SIGMA_MID_STANCE_GOAL_N = 0.25
COVERAGE_GOAL = (0.93, 0.97)
PHASE_COVERAGE_GOAL = (0.90, 0.99)
COVERAGE_GOAL_DRAWS = 100
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
    def is_met(self) -> bool:
        """True if the value is within the limits; False for NaN."""
        low = -math.inf if self.least is None else self.least
        return low <= self.value <= self.most

    def as_dict(self) -> dict[str, object]:
        """Return the JSON representation."""
        return asdict(self) | {"met": self.is_met}


def compare_with_goals(figures: SceneFigures) -> list[Goal]:
    """Compare a scene's figures with the goals."""
    goals = []
    for mode in LAGS_MS:
        measured = figures.figures_by_mode_and_label[mode, figures.default_model_set.label]
        medians = {name: spread.median for name, spread in measured.figures.items()}
        limits = [
            ("COP 95th percentile, mm", "cop_p95_m", 1e3, COP_P95_GOALS_M[mode]),
            ("GRF in flight, magnitude of the mean, N", "flight_mean_n", 1.0, FLIGHT_MEAN_GOAL_N),
            ("GRF sigma in mid-stance, N", "grf_sigma_mid_stance_n", 1.0, SIGMA_MID_STANCE_GOAL_N),
        ]
        if figures.scene in GRF_MAE_GOALS_N:
            most_n = GRF_MAE_GOALS_N[figures.scene][mode]
            limits.insert(0, ("GRF mean absolute error, N", "grf_mae_n", 1.0, most_n))
        goals += [
            Goal(mode, title, scale * medians[name], None, scale * most)
            for title, name, scale, most in limits
        ]
        for name, covered in measured.coverage.items():
            if name == "after_saturation":
                continue  # reported, without a goal
            low, high = PHASE_COVERAGE_GOAL if name in PHASES else COVERAGE_GOAL
            title = f"covered by the 95 % interval, {COVERAGE_TITLES[name]}, %"
            goals.append(Goal(mode, title, 100 * covered.share, 100 * low, 100 * high))
    return goals


COVERAGE_TITLES = {
    "all": "GRF, all frames",
    **{phase: f"GRF, {phase.replace('_', '-')}" for phase in PHASES},
    "cop_x": "COP x",
    "after_saturation": "GRF, after saturation",
}
"""Titles of the coverage figures."""


SIGNED_FIGURES = ("flight_mean_n", "grf_bias_n")
"""Signed figures, summarized by magnitude so that draws do not cancel."""


BUDGET_FIGURES = ("grf_mae_n", "cop_p95_m")
"""Figures that are compared with those of the full model set, draw by draw."""


@dataclass(frozen=True)
class Quantiles:
    """Median, 5th and 95th percentile and number of a figure's values over draws or repetitions."""

    median: float
    p5: float
    p95: float
    n: int

    @classmethod
    def from_values(cls, values: Sequence[float]) -> Quantiles:
        """Compute the percentiles of all finite values."""
        finite = [value for value in values if math.isfinite(value)]
        if not finite:
            return cls(math.nan, math.nan, math.nan, 0)
        p5, median, p95 = np.percentile(finite, [5.0, 50.0, 95.0]).tolist()
        return cls(median, p5, p95, len(finite))


@dataclass(frozen=True)
class ModelSetFigures:
    """Figures of one model set in one mode.

    Attributes:
        lag_ms: look-ahead.
        ns_per_frame: CPU time over repetitions.
        figures: fields of `Accuracy` over draws; magnitudes of signed ones.
        coverage: pooled over all frames of all draws: GRF in all frames and in each of `PHASES`,
            "cop_x" and "after_saturation".
        beyond_whole: excess of `BUDGET_FIGURES` over those of the full model set in the same
            draw, over draws.
    """

    lag_ms: float
    ns_per_frame: Quantiles
    figures: Mapping[str, Quantiles]
    coverage: Mapping[str, CoverageCount]
    beyond_whole: Mapping[str, Quantiles]


@dataclass(frozen=True)
class SceneFigures:
    """Figures of one scene."""

    scene: str
    tile_count: int
    rate_hz: float
    absent_models: tuple[str, ...]
    assumed_scale: bool
    draw_count: int
    """Number of draws with figures."""
    frames: Quantiles
    model_sets: tuple[ComparedModelSet, ...]
    figures_by_mode_and_label: Mapping[tuple[str, str], ModelSetFigures]
    """Figures by mode and label of the model set."""
    failures: tuple[MeasurementFailure, ...]

    @property
    def default_model_set(self) -> ComparedModelSet:
        """The scene's full model set."""
        return next(model_set for model_set in self.model_sets if model_set.is_full_set)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON representation."""
        return {
            "scene": self.scene,
            "tiles": self.tile_count,
            "rate_hz": self.rate_hz,
            "models": list(self.default_model_set.models),
            "absent_models": list(self.absent_models),
            "absolute_scale": "assumed" if self.assumed_scale else "measured",
            "draws": self.draw_count,
            "frames": self.frames,
            "failures": self.failures,
            "model_sets": [
                {
                    "label": model_set.label,
                    "models": list(model_set.models),
                    "added_model": model_set.added_model,
                    "missing_model": model_set.missing_model,
                    "extra_model": model_set.extra_model,
                    "is_full_set": model_set.is_full_set,
                    **{
                        mode: self.figures_by_mode_and_label[mode, model_set.label]
                        for mode in LAGS_MS
                    },
                }
                for model_set in self.model_sets
            ],
        }


def summarize_model_sets(
    model_sets: Sequence[ComparedModelSet],
    draws: Sequence[DrawResult],
    times_ns: Mapping[tuple[str, str], Sequence[float]],
) -> dict[tuple[str, str], ModelSetFigures]:
    """Summarize every model set in every mode, by mode and label."""
    measured = {}
    whole = next(model_set for model_set in model_sets if model_set.is_full_set)
    for model_set in model_sets:
        for mode, lag_ms in LAGS_MS.items():
            key = mode, model_set.label
            judged = [d.accuracy[key] for d in draws if key in d.accuracy]
            both = [
                (d.accuracy[key], d.accuracy[mode, whole.label])
                for d in draws
                if key in d.accuracy and (mode, whole.label) in d.accuracy
            ]
            measured[key] = ModelSetFigures(
                lag_ms,
                Quantiles.from_values(times_ns.get(key, ())),
                summarize_accuracy(judged),
                pool_coverage(judged),
                {
                    name: Quantiles.from_values(
                        [getattr(a, name) - getattr(b, name) for a, b in both]
                    )
                    for name in BUDGET_FIGURES
                },
            )
    return measured


def summarize_accuracy(accuracies: Sequence[Accuracy]) -> dict[str, Quantiles]:
    """Summarize every numeric field of `Accuracy` over draws."""
    names = [f.name for f in fields(Accuracy) if f.type in ("float", "int")]
    figures = {}
    for name in names:
        values = [float(getattr(a, name)) for a in accuracies]
        figures[name] = Quantiles.from_values(
            [abs(v) for v in values] if name in SIGNED_FIGURES else values
        )
    return figures


def pool_coverage(accuracies: Sequence[Accuracy]) -> dict[str, CoverageCount]:
    """Pool the coverage of the 95 % interval over the frames of all draws."""
    nothing = CoverageCount(0, 0)
    phases = {phase: sum((a.grf_phases[phase] for a in accuracies), nothing) for phase in PHASES}
    return {
        "all": sum(phases.values(), nothing),
        **phases,
        "cop_x": sum((a.cop_covered for a in accuracies), nothing),
        "after_saturation": sum((a.after_saturation for a in accuracies), nothing),
    }


def find_pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
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
