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
        rig_options: options of the rig.
        node_folder: the node's folder.
        server_url: address of the server; None: no server, local recording only.
        session_name: name of a session to record on the node itself; None: no recording.
        calibration: calibration of the tiles, for the server's estimates.
        calibration_problem: reason why there is no calibration.
        token: the server's token; None: the token of this user's server on this machine.
        ca_path: file or folder of CA certificates, in addition to the system's.
    """

    rig_options: RigOptions
    node_folder: Path
    server_url: str | None
    session_name: str | None = None
    calibration: Calibration | None = None
    calibration_problem: str | None = None
    token: str | None = None
    ca_path: Path | None = None
