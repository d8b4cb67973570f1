"""What a comparison with an emulated plate says is true, as far as the truth is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
import pytest

from devices.scene.scene_file import load_scene
from service.estimation import OFFLINE_LAG_MS
from service.offline.calibration_lookup import find_calibration
from service.offline.compare.block_covariance import UncertainValue
from service.offline.simulation import SimulationOptions, run_simulation
from service.rig.emulated_foot import EmulatedFoot, PlateFiles
from service.sessions.estimate_stream import EstimateOptions
from studies.reproduce.experiments import POPPY, ROLLING, ExperimentSetup
from studies.reproduce.result import (
    InjectedValueCheck,
    TrialResult,
    evaluate_trial,
)

pytestmark = pytest.mark.slow


def recorded(
    setup: ExperimentSetup, folder: Path, cache: Path
) -> tuple[TrialResult, dict[str, npt.NDArray[np.float64]]]:
    """A trial in virtual time, judged by its plate, and its columns with the truth."""
    scene = load_scene(setup.scene)
    if setup.domes_cover_sole:
        ground = scene.ground.model_copy(update={"dome_share": 1.0})
        scene = scene.model_copy(update={"ground": ground})
    reference, session = folder / f"plate{setup.file_suffix}", folder / "session.parquet"
    plates = PlateFiles(**{setup.instrument.replace(" ", "_"): reference})
    serials = [tile.serial for tile in scene.tile]

    def estimate() -> EstimateOptions:
        calibration = find_calibration(
            "emulated-rig", serials, cache_folder=cache / "foottile" / "rig"
        )
        return EstimateOptions(calibration, scene.models, OFFLINE_LAG_MS)

    foot = EmulatedFoot(seed=5, plates=plates)
    options = SimulationOptions(scene, seconds=6.0, with_truth=True, foot=foot)
    run_simulation(options, session, estimate)
    table = pq.read_table(session)
    names = ("grf_n", "true_plate_n", "cop_x_m", "cop_y_m", "true_cop_x_m", "true_cop_y_m")
    columns = {name: table[name].to_numpy().astype(np.float64) for name in names}
    return evaluate_trial(setup, "trial", session, reference), columns


def test_an_error_against_a_force_plate_is_the_true_one_but_for_the_plate_s_own(
    tmp_path: Path, bench_cache: Path
) -> None:
    judged, columns = recorded(POPPY, tmp_path, bench_cache)
    loaded = columns["true_plate_n"] > 0.5
    true_n = np.abs(columns["grf_n"] - columns["true_plate_n"])[loaded].mean()
    # Gain within 0.5 % of some 10 N, 0.1 N of noise on top of ours, and a lag to a tenth of a ms.
    assert judged.figures["grf_mae_n"] == pytest.approx(true_n, abs=0.08)
    assert judged.figures["stances"] == 3
    assert judged.checks["lag_s"].is_inside_interval
    assert judged.checks["drift_ppm"].is_inside_interval
    assert judged.checks["offset_n"].is_inside_interval
    lag = judged.checks["lag_s"]
    assert lag.found is not None
    assert lag.found.value == pytest.approx(lag.injected, abs=1.5e-3)


def test_a_cop_against_a_pressure_plate_is_the_true_one_but_for_cells_and_placement(
    tmp_path: Path, bench_cache: Path
) -> None:
    judged, columns = recorded(ROLLING, tmp_path, bench_cache)
    loaded = columns["true_plate_n"] > 3.0
    off_m = columns["cop_x_m"][loaded] - columns["true_cop_x_m"][loaded]
    true_m = float(np.nanpercentile(np.abs(off_m), 95))
    # Cells of 5 mm under patches of 2 mm, and a degree on 21 mm.
    assert judged.figures["cop_p95_about_mean_m"] == pytest.approx(true_m, abs=1.2e-3)
    assert judged.figures["cop_p95_m"] < 0.004
    assert judged.checks["lag_s"].is_inside_interval


def test_a_wrong_injection_would_be_noticed_and_nothing_found_is_nothing_inside() -> None:
    found = UncertainValue(value=0.500, sigma=0.001, dof=10.0)
    assert InjectedValueCheck(found, 0.5021).is_inside_interval
    assert not InjectedValueCheck(found, 0.505).is_inside_interval
    assert InjectedValueCheck(found, 0.505, beside=0.003).is_inside_interval, (
        "within what the plate's own noise adds"
    )
    assert not InjectedValueCheck(None, 0.5).is_inside_interval
