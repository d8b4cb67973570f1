"""What an estimate of a session is asked to be: values, which may go to another machine."""

from __future__ import annotations

from dataclasses import dataclass

from devices.scene.file import Scene
from service.estimation.calibration import Calibration
from storage.formats.slice import Slice

_ALL = Slice()
PIECE_FRAMES = 1 << 20
"""About ten seconds of work, which is what a kill may cost: half an hour at 544 Hz."""


@dataclass(frozen=True)
class EstimateRequest:
    """What is asked for; see `foottile estimate --help` for what is taken from where.

    Attributes:
        calibration: one, or its file, preset or id; None: the session's own.
        models: None: the scene's.
        lag_ms: look-ahead.
        scene: whose models, calibration and places are used; None: the session's.
        tare_s: unloaded interval, in seconds from the first frame of the session.
        part: seconds that are estimated; no more is read of the file than they need.
        exact: nothing is rounded.
    """

    calibration: str | Calibration | None
    models: tuple[str, ...] | None
    lag_ms: float
    scene: Scene | None
    tare_s: tuple[float, float] | None
    part: Slice = _ALL
    exact: bool = False
