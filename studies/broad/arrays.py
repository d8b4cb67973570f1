"""Evaluation of one random array: calibration on its rig, all scenes and conditions, errors."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from devices.emulation.parts import make_rng
from devices.scene.scene_file import Scene, load_scene
from service.estimation.calibration import Calibration
from service.offline.calibration_lookup import EMULATED_RIG, RIG_REFERENCE, find_calibration
from studies.benchmark.draws import (
    LAGS_MS,
    compute_estimates,
    describe_error,
    record_with_calibration,
)
from studies.broad.evaluation import (
    EVALUATED_COLUMNS,
    describe_tiles,
    evaluate_estimates,
    find_unsaturated_tiles,
)
from studies.broad.results import (
    FIRST_SEEDS,
    ArrayResult,
    CaseResult,
    RefusedItem,
    Seeds,
    TileResult,
    make_case_key,
)

SCENES = ("rolling", "poppy", "mud")
SERIALS = ("T01", "T02", "T03", "T04")
"""Serials of the tiles, the same in all three scenes."""
ROLLING_SCENE_S = 12.0
"""One pass of the arc, back, and half another."""
HEAVY = "heavy"
_HEAVY = {"mass_kg": 3.3, "leg_n_per_m": 2250.0, "strength_n_per_cm3": 1.0}
"""A leg of 3.3 kg on firmer poppy seeds: 28 N within 50 ms, near or beyond the range of the softer
domes."""
CLEAN = "clean"
MAX_REPEATABILITY = 0.03
CONDITIONS: Mapping[str, str] = {
    CLEAN: "repeatability 0, drift 0, white noise",
    "repeatability": "loadings differ as on the array's rig, by 0 to 3 %",
    "correlated": "noise correlated over 10 ms, of the same variance",
    "drift": "gains have drifted by up to 1 % since the calibration",
}


@dataclass(frozen=True)
class ArrayTask:
    """Array to evaluate; `repeatability` None: drawn at random."""

    number: int
    seeds: Seeds
    made_by: str
    repeatability: float | None = None

    @property
    def seed(self) -> int:
        """Seed of its parts, noise and grounds."""
        return FIRST_SEEDS[self.seeds] + self.number


def run_array(task: ArrayTask) -> ArrayResult:
    """Calibrate and evaluate one array; failures are returned, not raised."""
    began_s = time.process_time()
    repeatability = task.repeatability
    if repeatability is None:
        drawn = make_rng(f"repeatability/{task.seed}").uniform(0.0, MAX_REPEATABILITY)
        repeatability = round(float(drawn), 6)
    calibration, refusals = _calibrate_array(task.seed, repeatability)
    bench_s = time.process_time() - began_s
    found: dict[str, CaseResult] = {}
    tiles: tuple[TileResult, ...] = ()
    if calibration is not None:
        for scene, condition in _iterate_cases(repeatability):
            try:
                found_here, tiles_here = _evaluate_case(scene, condition, task.seed, calibration)
            except Exception as error:
                refusals.append(
                    RefusedItem(what=f"{scene.name}, {condition}", why=describe_error(error))
                )
            else:
                found |= found_here
                tiles = tiles_here or tiles
    return ArrayResult(
        number=task.number,
        seeds=task.seeds,
        made_by=task.made_by,
        repeatability=repeatability,
        cpu_bench_s=bench_s,
        cpu_scenes_s=time.process_time() - began_s - bench_s,
        tiles=tiles,
        judged=found,
        tiles_refused=0 if calibration is not None else len(refusals),
        refusals=tuple(refusals),
    )


def _calibrate_array(
    seed: int, repeatability: float
) -> tuple[Calibration | None, list[RefusedItem]]:
    """Calibrate the array; None with the reasons if a tile is refused."""
    entries: list[Calibration] = []
    refusals = []
    with tempfile.TemporaryDirectory(prefix="foottile-broad-") as work:
        for serial in SERIALS:
            try:
                entries.append(
                    find_calibration(
                        EMULATED_RIG,
                        [serial],
                        parts_seed=seed,
                        family="broad",
                        repeatability=repeatability,
                        cache_folder=Path(work),
                    )
                )
            except Exception as error:
                # Without the path of the temporary folder.
                why = re.sub(r"\S*/(?=bench-)", "", describe_error(error))
                refusals.append(RefusedItem(what=f"calibration of {serial}", why=why))
    if refusals:
        return None, refusals
    tiles = tuple(tile for entry in entries for tile in entry.tiles)
    whole = Calibration(
        name=EMULATED_RIG, reference=RIG_REFERENCE, date=entries[0].date, tiles=tiles
    )
    return whole, []


def _iterate_cases(repeatability: float) -> Iterator[tuple[Scene, str]]:
    """Yield every scene under every condition; the heavy leg under one."""
    changes: Mapping[str, Mapping[str, Any]] = {
        CLEAN: {},
        "repeatability": {"repeatability": repeatability},
        "correlated": {"correlated_ms": 10.0},
        "drift": {"gain_drift": 0.01},
    }
    for condition in CONDITIONS:
        for name in SCENES:
            yield _make_broad_scene(load_scene(name), **changes[condition]), condition
    poppy = load_scene("poppy")
    ground = poppy.ground.model_copy(update=_HEAVY)
    yield _make_broad_scene(poppy.model_copy(update={"ground": ground})), HEAVY


def _make_broad_scene(scene: Scene, **changes: Any) -> Scene:
    """Return the scene with broad parts and without the servo, which no figure needs."""
    emulation = scene.emulation.model_copy(update={"family": "broad", **changes})
    return scene.model_copy(update={"emulation": emulation, "servo": None})


def _evaluate_case(
    scene: Scene, condition: str, seed: int, calibration: Calibration
) -> tuple[dict[str, CaseResult], tuple[TileResult, ...]]:
    """Evaluate one recording in both modes; for clean poppy seeds also describe the tiles."""
    seconds = ROLLING_SCENE_S if scene.name == "rolling" else None
    recording, world = record_with_calibration(scene, seconds, seed, calibration)
    below_end = cache(partial(find_unsaturated_tiles, recording, world))
    found = {}
    for mode, lag_ms in LAGS_MS.items():
        columns = compute_estimates(recording, scene.models, lag_ms, EVALUATED_COLUMNS)
        found[make_case_key(scene.name, condition, mode)] = evaluate_estimates(
            columns, below_end, lag_ms
        )
    is_reference = scene.name == "poppy" and condition == CLEAN
    return found, describe_tiles(recording, world, seed) if is_reference else ()
