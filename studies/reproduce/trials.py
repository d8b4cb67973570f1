"""Trials of the paper's experiments: setups with scene and instrument, and the plan of a run.

Scenes are the built-in ones, with the paper's standard deviation of 0.03 between loadings and the
calibration made in this run.

PAPER is Ruppert and Badri-Sproewitz 2020 (hardware.md 0). The data behind most of its figures are
not available, only the values in its text.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np

from devices.arrays import Floats

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

_EQUATION_2 = (0.1309, 0.5702, 0.02354, 0.13)


def compute_normalised_force(output: Floats) -> Floats:
    """Compute the paper's curve in normalised variables: 0 without output, 1 at the greatest.

    Its units are not published (hardware.md 7): only the shape is compared.
    """
    curve = np.polynomial.Polynomial(_EQUATION_2)
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
