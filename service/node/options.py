"""Options of a node."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from service.estimation.calibration import Calibration
from service.rig.options import RigOptions


@dataclass(frozen=True)
class NodeOptions:
    """Options of a node.

    Attributes:
        rig: options of the rig.
        journal: the node's folder.
        server: address of the server; None: no server, local recording only.
        record: name of a session to record on the node itself; None: no recording.
        calibration: calibration of the tiles, for the server's estimates.
        calibration_problem: reason why there is no calibration.
        token: the server's token; None: the token of this user's server on this machine.
        ca: file or folder of CA certificates, in addition to the system's.
    """

    rig: RigOptions
    journal: Path
    server: str | None
    record: str | None = None
    calibration: Calibration | None = None
    calibration_problem: str | None = None
    token: str | None = None
    ca: Path | None = None
