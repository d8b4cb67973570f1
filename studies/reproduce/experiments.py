"""Experiments of the paper: tiles under the emulated indenter, trials in the laboratory.

The indenter runs in virtual time, and its tiles are fitted as by `foottile calibrate`. Scenes of
trials are the built-in ones, with the paper's standard deviation of 0.03 between loadings and the
calibration made in this run.

PAPER is Ruppert and Badri-Sproewitz 2020 (hardware.md 0). The data behind most of its figures are
not available, only the values in its text.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from devices.arrays import Floats
from devices.scene.scene_file import Scene
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.domes import (
    PAPER_EQUATION_2,
    Dome,
    SlowSaturationLoad,
    compute_saturation_load,
)
from service.estimation.fitting.least_squares import (
    compute_curve_through_zero_n,
    compute_mean_curve_half_width_95_n,
)
from service.estimation.fitting.rig.indentation import Strokes, average_stroke_blocks, select_loaded
from service.estimation.fitting.static_fit import fit_static_curve
from service.offline.calibration_fit import TileRecording, fit_calibration, read_indentations
from service.offline.calibration_lookup import RIG_REFERENCE, RIG_REFERENCE_DELAY, make_rig_scene
from service.offline.simulation import SimulationOptions, run_simulation
from service.rig.emulated_foot import EmulatedFoot

CITED = (
    "Ruppert and Badri-Spröwitz, *FootTile: a Rugged Foot Sensor for Force and Center of Pressure "
    "Sensing in Soft Terrain*, 2020, arXiv 2005.09025"
)
REPEATABILITY = 0.03
"""Standard deviation of the normalised output between loadings (III-A)."""
DOME_RANGE_N = (25.0, 35.0)
"""Range of the 11 mm dome of Vytaflex 60 (III-A); none is stated for other domes."""
MAX_GRF_ERROR_N = 1.0
"""Upper bound of the mean GRF error (III)."""
MAX_COP_ERROR_M = 0.004
"""Upper bound of the COP error (III)."""
FRAME_RATE_HZ = 330.0
"""Frame rate of four tiles (II-C)."""
LEG_WEIGHT_N = 8.92


def compute_normalised_force(output: Floats) -> Floats:
    """Compute the paper's curve in normalised variables: 0 without output, 1 at the greatest.

    Its units are not published (hardware.md 7): only the shape is compared.
    """
    curve = np.polynomial.Polynomial(PAPER_EQUATION_2)
    return np.asarray((curve(output) - curve(0.0)) / (curve(1.0) - curve(0.0)))


TRIALS = 4
FORCE_PLATE, PRESSURE_PLATE = "force plate", "pressure plate"


@dataclass(frozen=True)
class ExperimentSetup:
    """Setup of one experiment.

    Attributes:
        name: its name, and that of its scene file.
        scene: name of the built-in scene.
        instrument: reference instrument.
        trial_seconds: duration of a trial after the lead-in.
        title: title in reports.
        domes_cover_sole: True if the domes bear the sole's entire load; else the scene's share.
    """

    name: str
    scene: str
    instrument: str
    trial_seconds: float
    title: str
    domes_cover_sole: bool = False

    @property
    def file_suffix(self) -> str:
        """Suffix of the instrument's file."""
        return ".csv" if self.instrument == FORCE_PLATE else ".npz"

    @property
    def node_option(self) -> str:
        """Option of `foottile node` for the instrument's file."""
        return f"--{self.instrument.replace(' ', '-')}"


ROLLING = ExperimentSetup("rolling", "rolling", PRESSURE_PLATE, 5.0, "Rolling over a plate")
POPPY = ExperimentSetup(
    "poppy", "poppy", FORCE_PLATE, 3.6, "Three hops on poppy seeds", domes_cover_sole=True
)
POPPY_RIM = ExperimentSetup(
    "poppy-rim", "poppy", FORCE_PLATE, 3.6, "Three hops on poppy seeds, a rim bears a fifth"
)
MUD = ExperimentSetup("mud", "mud", FORCE_PLATE, 3.6, "Three hops in mud", domes_cover_sole=True)
SETUPS = (ROLLING, POPPY, POPPY_RIM, MUD)


def compose_scene_toml(setup: ExperimentSetup, calibration: Path) -> str:
    """Compose the text of the setup's scene file."""
    folder = resources.files("devices.scene") / "builtin"
    text = (folder / f"{setup.scene}.toml").read_text("utf-8").rstrip()
    # The ground is a built-in scene's last section.
    sole = "\ndome_share = 1.0" if setup.domes_cover_sole else ""
    emulation = f"\n\n[emulation]\nrepeatability = {REPEATABILITY}\n"
    return f"calibration = {json.dumps(str(calibration))}\n{text}{sole}{emulation}"


LEAD_S = 1.5
"""Unloaded lead-in of each trial, for the tare and the plate's start."""


@dataclass(frozen=True)
class TrialPlan:
    """Plan of one trial of a setup.

    Attributes:
        setup: its setup.
        number: number, from 1.
        seed: seed of noise, ground and the plate's properties.
        reference_path: path of the plate's file.
        is_repeated: True for the repetition of a failed trial.
    """

    setup: ExperimentSetup
    number: int
    seed: int
    reference_path: Path

    is_repeated: bool = False

    @property
    def trial_name(self) -> str:
        """Name of the trial, the same for its repetition."""
        return f"{self.setup.name}-{self.number}"

    @property
    def session_name(self) -> str:
        """Name of node and session."""
        return f"{self.trial_name}-again" if self.is_repeated else self.trial_name

    def make_repetition(self) -> TrialPlan:
        """Return the plan of a repetition with the same seed, after a failure."""
        path = self.reference_path
        beside = path.with_name(f"{path.stem}-again{path.suffix}")
        return replace(self, is_repeated=True, reference_path=beside)

    @property
    def recording_seconds(self) -> float:
        """Recording time from the node's connection on, shortly after its scene begins."""
        return LEAD_S + self.setup.trial_seconds

    def make_node_arguments(self, scene: Path, parts_seed: int) -> list[str]:
        """Return the arguments of `foottile node`."""
        return [
            f"--scene={scene}",
            f"--seed={self.seed}",
            f"--parts-seed={parts_seed}",
            f"--lead-s={LEAD_S}",
            f"{self.setup.node_option}={self.reference_path}",
        ]


def plan_trials(
    setups: tuple[ExperimentSetup, ...], trials: int, seed: int, folder: Path
) -> list[TrialPlan]:
    """Plan all trials, in order of setups."""
    return [
        TrialPlan(
            setup,
            number,
            seed + number,
            folder / f"{setup.name}-{number}{setup.file_suffix}",
        )
        for setup in setups
        for number in range(1, trials + 1)
    ]


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
    name = f"indenter-{scene.tile[0].serial}"
    with _record_indentation(scene, seed, parts_seed) as recordings:
        return fit_calibration(
            recordings, name=name, reference_name=RIG_REFERENCE, reference_delay=RIG_REFERENCE_DELAY
        )


@contextmanager
def _record_indentation(
    scene: Scene, seed: int, parts_seed: int
) -> Iterator[Mapping[str, Sequence[TileRecording]]]:
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
