"""Figures over arrays: error quantiles, pooled and worst coverage, lost models, goals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from scipy.special import chdtri

from service.offline.accuracy import PHASES, Covered
from service.offline.benchmark.broad.arrays import CLEAN, CONDITIONS, HEAVY, SCENES, SERIALS
from service.offline.benchmark.broad.results import ArrayResult, Judged, Phase, Tile, key_of
from service.offline.benchmark.draws import LAGS_MS
from service.offline.benchmark.figures import (
    COVERAGE,
    COVERAGE_OF_A_PHASE,
    COVERED,
    Goal,
    Spread,
)

EXCEEDS_N = 0.1
"""Effect on the force above which a tile needs the model."""
ANY_PHASE = "all"

# Goals of issue 14, by mode: median and 95th percentile over arrays.
GRF_MAE_N = {
    "rolling": {"live": (0.20, 0.35), "offline": (0.16, 0.30)},
    "poppy": {"live": (0.20, 0.35), "offline": (0.16, 0.30)},
    "mud": {"live": (0.30, 0.55), "offline": (0.27, 0.50)},
}
_PEAK_N = {"live": 0.5, "offline": 0.4}
COP_P95_MM = {"live": (0.8, 1.2), "offline": (0.6, 1.0)}
_WORST_COVERAGE = 0.80
_SIGMA_OVER_RMS = (0.8, 1.3)
_MODELS_SHARE = 0.01


@dataclass(frozen=True)
class Row:
    """Summary over arrays of one scene under one condition in one mode.

    Attributes:
        scene: its name.
        condition: one of `CONDITIONS`, or `HEAVY`.
        mode: live or offline.
        errors: quantiles of `grf_mae_n`, `peak_error_n`, `cop_p95_m` and the magnitude of
            `flight_mean_n`.
        coverage: pooled over all frames, by the keys of `COVERED`.
        coverage_of_arrays: quantiles of the arrays' coverage.
        sigma_over_rms: quantiles of stated over actual error, in all frames and in each phase.
        sums: counts of flags over all arrays.
        after_saturation_mae_n: error in frames after saturation, over arrays with any.
    """

    scene: str
    condition: str
    mode: str
    errors: Mapping[str, Spread]
    coverage: Mapping[str, Covered]
    coverage_of_arrays: Mapping[str, Spread]
    sigma_over_rms: Mapping[str, Spread]
    sums: Mapping[str, int]
    after_saturation_mae_n: Spread


ERRORS = ("grf_mae_n", "peak_error_n", "cop_p95_m", "flight_mean_n")
SUMS = (
    "frames",
    "saturated_frames",
    "saturated_tile_frames",
    "wrongly",
    "held",
    "grf_bounds",
    "grf_bounds_held",
    "after_frames",
)
ALARMS_PER_HOUR = 1.0
"""Upper limit of false alarms, with 95 % confidence: healthy tiles flagged as faulty."""


def rows_of(results: Sequence[ArrayResult]) -> list[Row]:
    """Summarize every case with a result, in the order of conditions and scenes."""
    places = [(scene, condition) for condition in CONDITIONS for scene in SCENES]
    rows = []
    for scene, condition in [*places, ("poppy", HEAVY)]:
        for mode in LAGS_MS:
            key = key_of(scene, condition, mode)
            judged = [result.judged[key] for result in results if key in result.judged]
            if judged:
                rows.append(_row(scene, condition, mode, judged))
    return rows


def _row(scene: str, condition: str, mode: str, judged: Sequence[Judged]) -> Row:
    phases = [{ANY_PHASE: _whole(j.phases.values()), **j.phases} for j in judged]
    covered = [
        {name: phase.covered for name, phase in of_array.items()}
        | {
            "cop_x": Covered(j.cop_frames, j.cop_within),
            "after_saturation": Covered(j.after_frames, j.after_within),
        }
        for of_array, j in zip(phases, judged, strict=True)
    ]
    return Row(
        scene,
        condition,
        mode,
        errors={name: Spread.of([_number(getattr(j, name)) for j in judged]) for name in ERRORS},
        coverage={name: sum((c[name] for c in covered), Covered(0, 0)) for name in COVERED},
        coverage_of_arrays={name: Spread.of([c[name].share for c in covered]) for name in COVERED},
        sigma_over_rms={
            name: Spread.of([of_array[name].sigma_over_rms for of_array in phases])
            for name in (ANY_PHASE, *PHASES)
        },
        sums={name: sum(getattr(j, name) for j in judged) for name in SUMS},
        after_saturation_mae_n=Spread.of([_number(j.after_saturation_mae_n) for j in judged]),
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else abs(value)


def _whole(phases: Iterable[Phase]) -> Phase:
    of_all = list(phases)
    return Phase(
        frames=sum(phase.frames for phase in of_all),
        within=sum(phase.within for phase in of_all),
        sigma2=sum(phase.sigma2 for phase in of_all),
        error2=sum(phase.error2 for phase in of_all),
    )


@dataclass(frozen=True)
class Models:
    """Number of tiles that need a model, lost it, lack its effect, and were given it anyway."""

    name: str
    needed: int
    lost: int
    lacking: int
    invented: int


def needs(tile: Tile, model: str) -> bool:
    """Return whether a tile needs a model; every tile needs the temperature model."""
    return model == "temperature" or tile.effect_n[model] > EXCEEDS_N


def models_of(results: Sequence[ArrayResult]) -> list[Models]:
    """Count tiles by need, for each model."""
    tiles = [tile for result in results for tile in result.tiles]
    counted = []
    for name in ("gas", "rubber", "hysteresis", "temperature"):
        needing = [tile for tile in tiles if needs(tile, name)]
        lacking = [tile for tile in tiles if name in tile.lacks]
        counted.append(
            Models(
                name,
                needed=len(needing),
                lost=sum(name not in tile.given for tile in needing),
                lacking=len(lacking),
                invented=sum(name in tile.given for tile in lacking),
            )
        )
    return counted


def goals_of(results: Sequence[ArrayResult]) -> list[Goal]:
    """Compare the figures with all goals of issue 14."""
    return [*error_goals(results), *sigma_goals(results)]


def sigma_goals(results: Sequence[ArrayResult]) -> list[Goal]:
    """Compare stated uncertainty with its goals: coverage, sigma and saturation."""
    goals = []
    for row in rows_of(results):
        if row.condition not in (HEAVY, "drift"):
            goals += _coverage(row)
        wrongly = float(row.sums["wrongly"])
        figure = f"{_name(row)}: tile frames called saturated well below the end"
        goals.append(Goal(row.mode, figure, wrongly, None, 0.0))
    return goals


@dataclass(frozen=True)
class Alarms:
    """False alarms in the live estimates of all recordings."""

    alarms: int
    hours: float

    @property
    def most_per_hour(self) -> float:
        """Upper 95 % confidence limit of their rate (Poisson)."""
        return float(chdtri(2 * (self.alarms + 1), 0.05)) / 2.0 / self.hours


def alarms_of(results: Sequence[ArrayResult]) -> Alarms:
    """Count false alarms over all scenes and conditions."""
    live = [j for r in results for key, j in r.judged.items() if key.endswith("/live")]
    return Alarms(sum(j.alarms for j in live), sum(j.seconds for j in live) / 3600.0)


def error_goals(results: Sequence[ArrayResult]) -> list[Goal]:
    """Compare errors in clean scenes, and lost models, with their goals."""
    goals = [goal for row in rows_of(results) if row.condition == CLEAN for goal in _errors(row)]
    pressed, refused = len(SERIALS) * len(results), sum(r.tiles_refused for r in results)
    share = 100.0 * refused / pressed if pressed else math.nan
    if (alarms := alarms_of(results)).hours > 0.0:
        figure = (
            f"false alarms an hour at most (95 %): {alarms.alarms} within {alarms.hours:.1f} hours"
        )
        goals.append(Goal("live", figure, alarms.most_per_hour, None, ALARMS_PER_HOUR))
    figure = "tiles refused by the calibration, %"
    goals.append(Goal("", figure, share, None, 100.0 * _MODELS_SHARE))
    for title, of, part in (
        ("tiles that lose a model whose effect exceeds 0.1 N, %", "needed", "lost"),
        ("tiles without an effect that are given its model, %", "lacking", "invented"),
    ):
        models = models_of(results)
        n, bad = (sum(getattr(model, name) for model in models) for name in (of, part))
        share = 100.0 * bad / n if n else math.nan
        goals.append(Goal("", title, share, None, 100.0 * _MODELS_SHARE))
    return goals


def _errors(row: Row) -> list[Goal]:
    grf_n, cop_m, peak_n = (row.errors[n] for n in ("grf_mae_n", "cop_p95_m", "peak_error_n"))
    mae, cop = GRF_MAE_N[row.scene][row.mode], COP_P95_MM[row.mode]
    figures = (
        ("GRF mean absolute error, N, median", grf_n.median, mae[0]),
        ("GRF mean absolute error, N, 95th percentile", grf_n.p95, mae[1]),
        ("stance peak, mean absolute error, N, median", peak_n.median, _PEAK_N[row.mode]),
        ("COP 95th percentile, mm, median", 1e3 * cop_m.median, cop[0]),
        ("COP 95th percentile, mm, 95th percentile", 1e3 * cop_m.p95, cop[1]),
    )
    return [
        Goal(row.mode, f"{_name(row)}: {title}", value, None, most)
        for title, value, most in figures
    ]


def _coverage(row: Row) -> list[Goal]:
    goals = []
    for name in (ANY_PHASE, *PHASES):
        low, high = COVERAGE_OF_A_PHASE if name in PHASES else COVERAGE
        value = 100.0 * row.coverage[name].share
        figure = f"{_name(row)}: covered, {COVERED[name]}, %"
        goals.append(Goal(row.mode, figure, value, 100.0 * low, 100.0 * high))
        if row.condition == CLEAN and name in PHASES:
            ratio = row.sigma_over_rms[name].median
            figure = f"{_name(row)}: sigma over error, {COVERED[name]}, median"
            goals.append(Goal(row.mode, figure, ratio, *_SIGMA_OVER_RMS))
    worst = 100.0 * row.coverage_of_arrays[ANY_PHASE].p5
    figure = f"{_name(row)}: covered, 5th percentile of arrays, %"
    return [*goals, Goal(row.mode, figure, worst, 100.0 * _WORST_COVERAGE, 100.0)]


def _name(row: Row) -> str:
    return row.scene if row.condition == CLEAN else f"{row.scene}, {row.condition}"
