"""Options of a session's re-estimation, as values that can be sent to another machine."""

from __future__ import annotations

from dataclasses import dataclass

from devices.scene.scene_file import Scene
from service.estimation.calibration import Calibration
from storage.formats.slice import Slice

_ALL = Slice()
CHUNK_FRAMES = 1 << 20
"""Frames per chunk: half an hour at 544 Hz, some ten seconds of work, which a kill may cost."""


@dataclass(frozen=True)
class EstimateRequest:
    """Options of an estimate; see `foottile estimate --help` for their defaults.

    Attributes:
        calibration: a calibration, or its file, preset or id; None: the session's own.
        models: model names; None: the scene's.
        lag_ms: look-ahead.
        scene: source of models, calibration and tile positions; None: the session's.
        tare_s: unloaded interval, in seconds from the first frame of the session.
        part: time range to estimate; only the needed part of the file is read.
        exact: True to store unquantized values.
    """

    calibration: str | Calibration | None
    models: tuple[str, ...] | None
    lag_ms: float
    scene: Scene | None
    tare_s: tuple[float, float] | None
    part: Slice = _ALL
    exact: bool = False
