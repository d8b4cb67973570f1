"""What a node is told to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from service.estimation.calibration import Calibration
from service.rig.options import RigOptions


@dataclass(frozen=True)
class NodeOptions:
    """What a node does.

    Attributes:
        rig: the array to open.
        journal: the node's folder.
        server: address of the server; None: none, it records for itself.
        record: name of a session to record on the node itself; None: no recording.
        calibration: of its tiles, for the server to estimate with.
        calibration_problem: why there is no calibration.
        token: of the server; None: that of a server which this user runs on this machine.
        ca: file or folder of CA certificates, beside those that the machine trusts.
    """

    rig: RigOptions
    journal: Path
    server: str | None
    record: str | None = None
    calibration: Calibration | None = None
    calibration_problem: str | None = None
    token: str | None = None
    ca: Path | None = None
