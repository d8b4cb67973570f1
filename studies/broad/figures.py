"""Figures over arrays: error quantiles, pooled and worst coverage, lost models, goals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from scipy.special import chdtri

from service.offline.accuracy import PHASES, CoverageCount
from studies.benchmark.draws import LAGS_MS
from studies.benchmark.figures import (
    COVERAGE_GOAL,
    COVERAGE_TITLES,
    PHASE_COVERAGE_GOAL,
    Goal,
    Quantiles,
)
from studies.broad.arrays import CLEAN, CONDITIONS, HEAVY, SCENES, SERIALS
from studies.broad.results import ArrayResult, CaseResult, PhaseCounts, TileResult, make_case_key

MIN_EFFECT_N = 0.1
"""Effect on the force above which a tile needs the model."""
ANY_PHASE = "all"

# Goals of issue 14, by mode: median and 95th percentile over arrays.
GRF_MAE_GOALS_N = {
    "rolling": {"live": (0.20, 0.35), "offline": (0.16, 0.30)},
    "poppy": {"live": (0.20, 0.35), "offline": (0.16, 0.30)},
    "mud": {"live": (0.30, 0.55), "offline": (0.27, 0.50)},
}
_PEAK_N = {"live": 0.5, "offline": 0.4}
COP_P95_GOALS_MM = {"live": (0.8, 1.2), "offline": (0.6, 1.0)}
_WORST_COVERAGE = 0.80
_SIGMA_OVER_RMS = (0.8, 1.3)
_MODELS_SHARE = 0.01


@dataclass(frozen=True)
class CaseSummary:
    """Summary over arrays of one scene under one condition in one mode.

    Attributes:
        scene: its name.
        condition: one of `CONDITIONS`, or `HEAVY`.
        mode: live or offline.
        errors: quantiles of `grf_mae_n`, `peak_error_n`, `cop_p95_m` and the magnitude of
            `flight_mean_n`.
        coverage: pooled over all frames, by the keys of `COVERAGE_TITLES`.
        coverage_of_arrays: quantiles of the arrays' coverage.
        sigma_over_rms: quantiles of stated over actual error, in all frames and in each phase.
        sums: counts of flags over all arrays.
        after_saturation_mae_n: error in frames after saturation, over arrays with any.
    """

    scene: str
    condition: str
    mode: str
    errors: Mapping[str, Quantiles]
    coverage: Mapping[str, CoverageCount]
    coverage_of_arrays: Mapping[str, Quantiles]
    sigma_over_rms: Mapping[str, Quantiles]
    sums: Mapping[str, int]
    after_saturation_mae_n: Quantiles


ERROR_FIELDS = ("grf_mae_n", "peak_error_n", "cop_p95_m", "flight_mean_n")
SUMMED_FIELDS = (
    "frames",
    "saturated_frames",
    "saturated_tile_frames",
    "wrongly",
    "held",
    "grf_bounds",
    "grf_bounds_held",
    "after_frames",
)
MAX_ALARMS_PER_HOUR = 1.0
"""Upper limit of false alarms, with 95 % confidence: healthy tiles flagged as faulty."""


def summarize_cases(results: Sequence[ArrayResult]) -> list[CaseSummary]:
    """Summarize every case with a result, in the order of conditions and scenes."""
    places = [(scene, condition) for condition in CONDITIONS for scene in SCENES]
    rows = []
    for scene, condition in [*places, ("poppy", HEAVY)]:
        for mode in LAGS_MS:
            key = make_case_key(scene, condition, mode)
            judged = [result.judged[key] for result in results if key in result.judged]
            if judged:
                rows.append(_summarize_case(scene, condition, mode, judged))
    return rows


def _summarize_case(
    scene: str, condition: str, mode: str, judged: Sequence[CaseResult]
) -> CaseSummary:
    phases = [{ANY_PHASE: _sum_phases(j.phases.values()), **j.phases} for j in judged]
    covered = [
        {name: phase.coverage for name, phase in of_array.items()}
        | {
            "cop_x": CoverageCount(j.cop_frames, j.cop_within),
            "after_saturation": CoverageCount(j.after_frames, j.after_within),
        }
        for of_array, j in zip(phases, judged, strict=True)
    ]
    return CaseSummary(
        scene,
        condition,
        mode,
        errors={
            name: Quantiles.from_values([_none_to_nan(getattr(j, name)) for j in judged])
            for name in ERROR_FIELDS
        },
        coverage={
            name: sum((c[name] for c in covered), CoverageCount(0, 0)) for name in COVERAGE_TITLES
        },
        coverage_of_arrays={
            name: Quantiles.from_values([c[name].share for c in covered])
            for name in COVERAGE_TITLES
        },
        sigma_over_rms={
            name: Quantiles.from_values([of_array[name].sigma_over_rms for of_array in phases])
            for name in (ANY_PHASE, *PHASES)
        },
        sums={name: sum(getattr(j, name) for j in judged) for name in SUMMED_FIELDS},
        after_saturation_mae_n=Quantiles.from_values(
            [_none_to_nan(j.after_saturation_mae_n) for j in judged]
        ),
    )


def _none_to_nan(value: float | None) -> float:
    return math.nan if value is None else abs(value)


def _sum_phases(phases: Iterable[PhaseCounts]) -> PhaseCounts:
    of_all = list(phases)
    return PhaseCounts(
        frames=sum(phase.frames for phase in of_all),
        within=sum(phase.within for phase in of_all),
        sigma2=sum(phase.sigma2 for phase in of_all),
        error2=sum(phase.error2 for phase in of_all),
    )


@dataclass(frozen=True)
class ModelCounts:
    """Number of tiles that need a model, lost it, lack its effect, and were given it anyway."""

    name: str
    needed: int
    lost: int
    lacking: int
    invented: int


def needs_model(tile: TileResult, model: str) -> bool:
    """Return whether a tile needs a model; every tile needs the temperature model."""
    return model == "temperature" or tile.effect_n[model] > MIN_EFFECT_N


def count_models(results: Sequence[ArrayResult]) -> list[ModelCounts]:
    """Count tiles by need, for each model."""
    tiles = [tile for result in results for tile in result.tiles]
    counted = []
    for name in ("gas", "rubber", "hysteresis", "temperature"):
        needing = [tile for tile in tiles if needs_model(tile, name)]
        lacking = [tile for tile in tiles if name in tile.lacks]
        counted.append(
            ModelCounts(
                name,
                needed=len(needing),
                lost=sum(name not in tile.given for tile in needing),
                lacking=len(lacking),
                invented=sum(name in tile.given for tile in lacking),
            )
        )
    return counted


def compare_with_goals(results: Sequence[ArrayResult]) -> list[Goal]:
    """Compare the figures with all goals of issue 14."""
    return [*compare_errors_with_goals(results), *compare_uncertainty_with_goals(results)]


def compare_uncertainty_with_goals(results: Sequence[ArrayResult]) -> list[Goal]:
    """Compare stated uncertainty with its goals: coverage, sigma and saturation."""
    goals = []
    for row in summarize_cases(results):
        if row.condition not in (HEAVY, "drift"):
            goals += _compare_row_coverage(row)
        wrongly = float(row.sums["wrongly"])
        figure = f"{_describe_row(row)}: tile frames called saturated well below the end"
        goals.append(Goal(row.mode, figure, wrongly, None, 0.0))
    return goals


@dataclass(frozen=True)
class FalseAlarms:
    """False alarms in the live estimates of all recordings."""

    count: int
    hours: float

    @property
    def upper_limit_per_hour(self) -> float:
        """Upper 95 % confidence limit of their rate (Poisson)."""
        return float(chdtri(2 * (self.count + 1), 0.05)) / 2.0 / self.hours


def count_false_alarms(results: Sequence[ArrayResult]) -> FalseAlarms:
    """Count false alarms over all scenes and conditions."""
    live = [j for r in results for key, j in r.judged.items() if key.endswith("/live")]
    return FalseAlarms(sum(j.alarms for j in live), sum(j.seconds for j in live) / 3600.0)


def compare_errors_with_goals(results: Sequence[ArrayResult]) -> list[Goal]:
    """Compare errors in clean scenes, and lost models, with their goals."""
    goals = [
        goal
        for row in summarize_cases(results)
        if row.condition == CLEAN
        for goal in _compare_row_errors(row)
    ]
    pressed, refused = len(SERIALS) * len(results), sum(r.tiles_refused for r in results)
    share = 100.0 * refused / pressed if pressed else math.nan
    if (alarms := count_false_alarms(results)).hours > 0.0:
        figure = (
            f"false alarms an hour at most (95 %): {alarms.count} within {alarms.hours:.1f} hours"
        )
        goals.append(Goal("live", figure, alarms.upper_limit_per_hour, None, MAX_ALARMS_PER_HOUR))
    figure = "tiles refused by the calibration, %"
    goals.append(Goal("", figure, share, None, 100.0 * _MODELS_SHARE))
    for title, of, part in (
        ("tiles that lose a model whose effect exceeds 0.1 N, %", "needed", "lost"),
        ("tiles without an effect that are given its model, %", "lacking", "invented"),
    ):
        models = count_models(results)
        n, bad = (sum(getattr(model, name) for model in models) for name in (of, part))
        share = 100.0 * bad / n if n else math.nan
        goals.append(Goal("", title, share, None, 100.0 * _MODELS_SHARE))
    return goals


def _compare_row_errors(row: CaseSummary) -> list[Goal]:
    grf_n, cop_m, peak_n = (row.errors[n] for n in ("grf_mae_n", "cop_p95_m", "peak_error_n"))
    mae, cop = GRF_MAE_GOALS_N[row.scene][row.mode], COP_P95_GOALS_MM[row.mode]
    figures = (
        ("GRF mean absolute error, N, median", grf_n.median, mae[0]),
        ("GRF mean absolute error, N, 95th percentile", grf_n.p95, mae[1]),
        ("stance peak, mean absolute error, N, median", peak_n.median, _PEAK_N[row.mode]),
        ("COP 95th percentile, mm, median", 1e3 * cop_m.median, cop[0]),
        ("COP 95th percentile, mm, 95th percentile", 1e3 * cop_m.p95, cop[1]),
    )
    return [
        Goal(row.mode, f"{_describe_row(row)}: {title}", value, None, most)
        for title, value, most in figures
    ]


def _compare_row_coverage(row: CaseSummary) -> list[Goal]:
    goals = []
    for name in (ANY_PHASE, *PHASES):
        low, high = PHASE_COVERAGE_GOAL if name in PHASES else COVERAGE_GOAL
        value = 100.0 * row.coverage[name].share
        figure = f"{_describe_row(row)}: covered, {COVERAGE_TITLES[name]}, %"
        goals.append(Goal(row.mode, figure, value, 100.0 * low, 100.0 * high))
        if row.condition == CLEAN and name in PHASES:
            ratio = row.sigma_over_rms[name].median
            figure = f"{_describe_row(row)}: sigma over error, {COVERAGE_TITLES[name]}, median"
            goals.append(Goal(row.mode, figure, ratio, *_SIGMA_OVER_RMS))
    worst = 100.0 * row.coverage_of_arrays[ANY_PHASE].p5
    figure = f"{_describe_row(row)}: covered, 5th percentile of arrays, %"
    return [*goals, Goal(row.mode, figure, worst, 100.0 * _WORST_COVERAGE, 100.0)]


def _describe_row(row: CaseSummary) -> str:
    return row.scene if row.condition == CLEAN else f"{row.scene}, {row.condition}"
