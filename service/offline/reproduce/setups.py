"""Setups of the paper's experiments: scene, instrument under the foot, and duration.

Scenes are the built-in ones, with the paper's standard deviation of 0.03 between loadings and the
calibration made in this run.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from service.offline.reproduce.paper import REPEATABILITY

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
