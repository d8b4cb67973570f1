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
from devices.scene.file import Scene
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.domes import Dome, DomeRange, range_of
from service.estimation.fitting.bench.indentation import Strokes, pressed_in, strokes
from service.estimation.fitting.confidence import curve_n, mean_band_n
from service.estimation.fitting.fit import fit_tile
from service.offline.calibrate import Pressed as MillRecording
from service.offline.calibrate import calibrate_recordings, read_recordings
from service.offline.calibrations import RIG_DELAY, RIG_REFERENCE, bench_scene
from service.offline.simulate import SimulateOptions, simulate
from service.rig.emulated import EmulatedFoot

OVERLOAD = 1.15
"""Greatest indentation force, relative to the upper range end expected by `foottile domes`."""
_LEVELS = 40


@dataclass(frozen=True)
class Pressed:
    """Indented tile with its fitted curve.

    Attributes:
        tile: its curve.
        strokes: data behind the fit.
    """

    tile: TileCalibration
    strokes: Strokes


@dataclass(frozen=True)
class DomeFound:
    """Result for one dome of Table I.

    Attributes:
        dome: the dome.
        pressed: its recording and fit.
        expected: its range by the paper or, scaled, by `foottile domes`.
        end_kpa: end of the chip's range, above the tile's baseline.
        full_scale_n: force at that end, and half width of its 95 % interval.
        reached: True if the recording reached that end; else extrapolated.
        spread: standard deviation of the normalised output between loadings.
    """

    dome: Dome
    pressed: Pressed
    expected: DomeRange
    end_kpa: float
    full_scale_n: tuple[float, float]
    reached: bool
    spread: float


def table_scene(dome: Dome) -> Scene:
    """Build the indenter scene of one dome of Table I, loaded beyond its expected range."""
    scene = bench_scene(dome.name, "table-1")
    load_n = OVERLOAD * range_of(dome).high_n
    return scene.model_copy(update={"ground": scene.ground.model_copy(update={"load_n": load_n})})


def press(scene: Scene, *, seed: int, parts_seed: int) -> Pressed:
    """Indent the only tile of a scene, and fit its curve.

    Raises:
        CalibrationError: the tile has no valid curve.
    """
    with _recorded(scene, seed, parts_seed) as recordings:
        ((pressed,),) = recordings.values()
        own = pressed.indentation
    return Pressed(fit_tile(own), strokes(*pressed_in([own])))


def calibrate(scene: Scene, *, seed: int, parts_seed: int) -> Calibration:
    """Indent the only tile of a scene, and fit its curve and all dome effects.

    Raises:
        CalibrationError: the tile has no valid curve.
    """
    name = f"mill-{scene.tile[0].serial}"
    with _recorded(scene, seed, parts_seed) as recordings:
        return calibrate_recordings(recordings, name=name, reference=RIG_REFERENCE, delay=RIG_DELAY)


@contextmanager
def _recorded(
    scene: Scene, seed: int, parts_seed: int
) -> Iterator[Mapping[str, Sequence[MillRecording]]]:
    with tempfile.TemporaryDirectory(prefix="foottile-mill-") as work:
        recording = Path(work) / "mill.parquet"
        foot = EmulatedFoot(seed=seed, parts_seed=parts_seed)
        simulate(SimulateOptions(scene, foot=foot), recording, None)
        yield read_recordings([recording])


def together(calibrations: Sequence[Calibration], name: str) -> Calibration:
    """Merge calibrations of single tiles."""
    return Calibration(
        name=name,
        reference=RIG_REFERENCE,
        date=max(one.date for one in calibrations),
        tiles=tuple(tile for one in calibrations for tile in one.tiles),
    )


def found_of(dome: Dome, pressed: Pressed) -> DomeFound:
    """Evaluate a dome's recording."""
    tile = pressed.tile
    beyond_kpa = 0.0 if tile.bench is None else tile.bench.spare_kpa
    end_kpa = tile.range_kpa[1] + beyond_kpa
    at_kpa = np.array([end_kpa])
    return DomeFound(
        dome=dome,
        pressed=pressed,
        expected=range_of(dome),
        end_kpa=end_kpa,
        full_scale_n=(float(curve_n(tile, at_kpa)[0]), float(mean_band_n(tile, at_kpa)[0])),
        reached=beyond_kpa <= 0.0,
        spread=spread_of(pressed.strokes),
    )


def spread_of(blocks: Strokes) -> float:
    """Compute the standard deviation of the output between loadings, over the greatest output.

    Model: each loading's output over force is the mean curve times the loading's gain.
    """
    loadings = [one.select(one.loading) for one in blocks.by_repeat()]
    end_n = min(float(one.force_n.max()) for one in loadings)
    levels_n = np.linspace(0.1 * end_n, end_n, _LEVELS)
    outputs = np.stack([_output_at(one, levels_n) for one in loadings])
    mean = outputs.mean(axis=0)
    gains = outputs @ mean / (mean @ mean)
    return float(gains.std(ddof=1))


def _output_at(loading: Strokes, levels_n: Floats) -> Floats:
    order = np.argsort(loading.force_n)
    return np.interp(levels_n, loading.force_n[order], loading.gauge_kpa[order])


def pooled(spreads: Sequence[float], loadings: int) -> tuple[float, tuple[float, float]]:
    """Pool the standard deviations of all tiles, with the 95 % interval of a normal variable."""
    dof = len(spreads) * (loadings - 1)
    variance = float(np.mean(np.square(spreads)))
    low, high = (float(np.sqrt(dof * variance / chdtri(dof, tail))) for tail in (0.025, 0.975))
    return float(np.sqrt(variance)), (low, high)
