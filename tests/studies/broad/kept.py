"""Results of arrays that nobody ran, with numbers small enough to check by hand."""

from __future__ import annotations

from typing import Any

from service.offline.accuracy import PHASES
from studies.broad.arrays import CONDITIONS, HEAVY, SCENES, ArrayTask
from studies.broad.results import (
    ArrayResult,
    CaseResult,
    PhaseCounts,
    TileResult,
    make_case_key,
)

TILE = TileResult(
    serial="T01",
    drawn={"gamma": 1.3},
    effect_n={"gas": 0.3, "rubber": 0.3, "hysteresis": 0.05},
    lacks=(),
    given=("gas", "rubber", "hysteresis", "temperature"),
    found={"gamma": 1.29, "gamma_sigma": 0.01},
    refused={},
    at_bound=(),
)


def judged(**changes: Any) -> CaseResult:
    """A hundred frames of each phase with an error of 0.1 N, as stated."""
    phase = PhaseCounts(frames=100, within=95, sigma2=1.0, error2=1.0)
    numbers: dict[str, Any] = {
        "frames": 400,
        "grf_mae_n": 0.1,
        "peak_error_n": 0.2,
        "cop_p95_m": 0.0005,
        "flight_mean_n": -0.01,
        "phases": dict.fromkeys(PHASES, phase),
        "cop_frames": 100,
        "cop_within": 95,
        "saturated_frames": 0,
        "saturated_tile_frames": 0,
        "wrongly": 0,
        "held": 0,
        "grf_bounds": 0,
        "grf_bounds_held": 0,
        "after_frames": 0,
        "after_within": 0,
        "after_saturation_mae_n": None,
        "seconds": 3600.0,
        "alarms": 0,
    }
    return CaseResult(**(numbers | changes))


def result(number: int = 0, tiles: tuple[TileResult, ...] = (TILE,), **changes: Any) -> ArrayResult:
    """An array that is the same in every scene; `changes` are of what was judged."""
    places = [(scene, condition) for condition in CONDITIONS for scene in SCENES]
    return ArrayResult(
        number=number,
        seeds="development",
        made_by="this code",
        repeatability=0.01,
        cpu_bench_s=20.0,
        cpu_scenes_s=10.0,
        tiles=tiles,
        judged={
            make_case_key(scene, condition, mode): judged(**changes)
            for scene, condition in [*places, ("poppy", HEAVY)]
            for mode in ("live", "offline")
        },
        tiles_refused=0,
        refusals=(),
    )


def made(task: ArrayTask) -> ArrayResult:
    """Instead of an array that takes its minute."""
    alike = 0.01 if task.repeatability is None else task.repeatability
    return result(task.number).model_copy(
        update={"made_by": task.made_by, "seeds": task.seeds, "repeatability": alike}
    )
