"""Tiles under the emulated indenter, in virtual time, fitted as by `foottile calibrate`."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from devices.arrays import Floats
from devices.scene.scene_file import Scene
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.domes import Dome, SlowSaturationLoad, compute_saturation_load
from service.estimation.fitting.least_squares import (
    compute_curve_through_zero_n,
    compute_mean_curve_half_width_95_n,
)
from service.estimation.fitting.rig.indentation import Strokes, average_stroke_blocks, select_loaded
from service.estimation.fitting.static_fit import fit_static_curve
from service.offline.calibration_fit import TileRecording as MillRecording
from service.offline.calibration_fit import fit_calibration, read_indentations
from service.offline.calibration_lookup import RIG_REFERENCE, RIG_REFERENCE_DELAY, make_rig_scene
from service.offline.simulation import SimulationOptions, run_simulation
from service.rig.emulated_foot import EmulatedFoot

OVERLOAD_FACTOR = 1.15
"""Greatest indentation force, relative to the upper range end expected by `foottile domes`."""
_FORCE_LEVELS = 40


@dataclass(frozen=True)
class IndentedTile:
    """Indented tile with its fitted curve.

    Attributes:
        tile: its curve.
        strokes: data behind the fit.
    """

    tile: TileCalibration
    strokes: Strokes


@dataclass(frozen=True)
class DomeResult:
    """Result for one dome of Table I.

    Attributes:
        dome: the dome.
        indented_tile: its recording and fit.
        expected_range: its range by the paper or, scaled, by `foottile domes`.
        end_kpa: end of the chip's range, above the tile's baseline.
        full_scale_n: force at that end, and half width of its 95 % interval.
        is_full_scale_reached: True if the recording reached that end; else extrapolated.
        repeatability: standard deviation of the normalised output between loadings.
    """

    dome: Dome
    indented_tile: IndentedTile
    expected_range: SlowSaturationLoad
    end_kpa: float
    full_scale_n: tuple[float, float]
    is_full_scale_reached: bool
    repeatability: float


def make_dome_scene(dome: Dome) -> Scene:
    """Build the indenter scene of one dome of Table I, loaded beyond its expected range."""
    scene = make_rig_scene(dome.name, "table-1")
    load_n = OVERLOAD_FACTOR * compute_saturation_load(dome).high_n
    return scene.model_copy(update={"ground": scene.ground.model_copy(update={"load_n": load_n})})


def indent_tile(scene: Scene, *, seed: int, parts_seed: int) -> IndentedTile:
    """Indent the only tile of a scene, and fit its curve.

    Raises:
        CalibrationError: the tile has no valid curve.
    """
    with _record_indentation(scene, seed, parts_seed) as recordings:
        ((pressed,),) = recordings.values()
        own = pressed.indentation
    return IndentedTile(fit_static_curve(own), average_stroke_blocks(*select_loaded([own])))


def calibrate_tile(scene: Scene, *, seed: int, parts_seed: int) -> Calibration:
    """Indent the only tile of a scene, and fit its curve and all dome effects.

    Raises:
        CalibrationError: the tile has no valid curve.
    """
    name = f"mill-{scene.tile[0].serial}"
    with _record_indentation(scene, seed, parts_seed) as recordings:
        return fit_calibration(
            recordings, name=name, reference_name=RIG_REFERENCE, reference_delay=RIG_REFERENCE_DELAY
        )


@contextmanager
def _record_indentation(
    scene: Scene, seed: int, parts_seed: int
) -> Iterator[Mapping[str, Sequence[MillRecording]]]:
    with tempfile.TemporaryDirectory(prefix="foottile-indentation-") as work:
        recording = Path(work) / "indentation.parquet"
        foot = EmulatedFoot(seed=seed, parts_seed=parts_seed)
        run_simulation(SimulationOptions(scene, foot=foot), recording, None)
        yield read_indentations([recording])


def merge_calibrations(calibrations: Sequence[Calibration], name: str) -> Calibration:
    """Merge calibrations of single tiles."""
    return Calibration(
        name=name,
        reference=RIG_REFERENCE,
        date=max(one.date for one in calibrations),
        tiles=tuple(tile for one in calibrations for tile in one.tiles),
    )


def evaluate_dome(dome: Dome, pressed: IndentedTile) -> DomeResult:
    """Evaluate a dome's recording."""
    tile = pressed.tile
    beyond_kpa = 0.0 if tile.rig is None else tile.rig.spare_kpa
    end_kpa = tile.range_kpa[1] + beyond_kpa
    at_kpa = np.array([end_kpa])
    return DomeResult(
        dome=dome,
        indented_tile=pressed,
        expected_range=compute_saturation_load(dome),
        end_kpa=end_kpa,
        full_scale_n=(
            float(compute_curve_through_zero_n(tile, at_kpa)[0]),
            float(compute_mean_curve_half_width_95_n(tile, at_kpa)[0]),
        ),
        is_full_scale_reached=beyond_kpa <= 0.0,
        repeatability=compute_repeatability(pressed.strokes),
    )


def compute_repeatability(blocks: Strokes) -> float:
    """Compute the standard deviation of the output between loadings, over the greatest output.

    Model: each loading's output over force is the mean curve times the loading's gain.
    """
    loadings = [one.select_rows(one.loading) for one in blocks.split_by_repeat()]
    end_n = min(float(one.force_n.max()) for one in loadings)
    levels_n = np.linspace(0.1 * end_n, end_n, _FORCE_LEVELS)
    outputs = np.stack([_interpolate_output(one, levels_n) for one in loadings])
    mean = outputs.mean(axis=0)
    gains = outputs @ mean / (mean @ mean)
    return float(gains.std(ddof=1))


def _interpolate_output(loading: Strokes, levels_n: Floats) -> Floats:
    order = np.argsort(loading.force_n)
    return np.interp(levels_n, loading.force_n[order], loading.gauge_kpa[order])


def pool_repeatability(
    spreads: Sequence[float], loadings: int
) -> tuple[float, tuple[float, float]]:
    """Pool the standard deviations of all tiles, with the 95 % interval of a normal variable."""
    dof = len(spreads) * (loadings - 1)
    variance = float(np.mean(np.square(spreads)))
    low, high = (float(np.sqrt(dof * variance / chdtri(dof, tail))) for tail in (0.025, 0.975))
    return float(np.sqrt(variance)), (low, high)
