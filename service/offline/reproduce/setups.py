"""What is recorded: the scenes of the paper's experiments, and which plate lies under the foot.

Scenes are the built-in ones with what the paper says of its own tiles, a standard deviation of 0.03
between loadings, and with the calibration that was made here.
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
class Setup:
    """One experiment.

    Attributes:
        name: of it, and of its scene's file.
        scene: built-in scene.
        whole_sole: do the domes bear all that the sole bears? Else they bear what the scene says.
        instrument: that it is compared with.
        seconds: of a trial, behind the lead.
        title: for people.
    """

    name: str
    scene: str
    instrument: str
    seconds: float
    title: str
    whole_sole: bool = False

    @property
    def ending(self) -> str:
        """Of the instrument's file."""
        return ".csv" if self.instrument == FORCE_PLATE else ".npz"

    @property
    def option(self) -> str:
        """Of `foottile node`, for that file."""
        return f"--{self.instrument.replace(' ', '-')}"


ROLLING = Setup("rolling", "rolling", PRESSURE_PLATE, 5.0, "Rolling over a plate")
POPPY = Setup("poppy", "poppy", FORCE_PLATE, 3.6, "Three hops on poppy seeds", whole_sole=True)
POPPY_RIM = Setup(
    "poppy-rim", "poppy", FORCE_PLATE, 3.6, "Three hops on poppy seeds, a rim bears a fifth"
)
MUD = Setup("mud", "mud", FORCE_PLATE, 3.6, "Three hops in mud", whole_sole=True)
SETUPS = (ROLLING, POPPY, POPPY_RIM, MUD)


def scene_text(setup: Setup, calibration: Path) -> str:
    """The scene's file."""
    folder = resources.files("devices.scene") / "builtin"
    text = (folder / f"{setup.scene}.toml").read_text("utf-8").rstrip()
    # The ground is a built-in scene's last section.
    sole = "\ndome_share = 1.0" if setup.whole_sole else ""
    emulation = f"\n\n[emulation]\nrepeatability = {REPEATABILITY}\n"
    return f"calibration = {json.dumps(str(calibration))}\n{text}{sole}{emulation}"
