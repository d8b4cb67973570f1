"""Which calibration the tiles of a node are estimated with, where the server was told which.

A node says its own with its hello. The server's choice takes its place, from the next frame on and
for sessions that begin then, until it is taken back; it is a copy, kept with the node. If that is
damaged, it is not known which calibration was meant: then there is none, rather than another one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from devices.errors import CalibrationError, DamagedFileError, StorageError
from service.estimation.calibration import Calibration
from storage.checked_json import read_checked, write_checked
from storage.durable import ASIDE, make_folder, put_aside, storage_errors

_LOST = "assign a calibration again, or take the assignment back"


@dataclass(frozen=True)
class Assigned:
    """A choice, and when it was made, in the server's UTC."""

    calibration: Calibration
    t_ns: int


class Assignment:
    """The choice for one node.

    Args:
        path: file that it is kept in.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.present: Assigned | None = None
        """None: the node's own calibration counts, unless the choice is lost."""
        self.problem: str | None = None
        """Why the choice is not known; None: it is, or there is none."""
        try:
            self.present = _read(path)
        except FileNotFoundError:
            if any(path.parent.glob(path.name + ASIDE + "*")):
                self.problem = f"the calibration that was assigned is lost: {_LOST}"
        except DamagedFileError as error:
            self.problem = f"the calibration that was assigned is lost ({put_aside(path, error)})"
            self.problem += f": {_LOST}"
        except StorageError as error:
            self.problem = f"the calibration that was assigned cannot be read: {error}"

    def put(self, calibration: Calibration, t_ns: int) -> None:
        """Choose a calibration.

        Raises:
            StorageError: that cannot be kept; the choice is what it was.
        """
        self._keep({"id": calibration.id, **calibration.model_dump(mode="json")}, t_ns)
        self.present, self.problem = Assigned(calibration, t_ns), None

    def take_back(self, t_ns: int) -> None:
        """The node's own counts again.

        Raises:
            StorageError: that cannot be kept; the choice is what it was.
        """
        self._keep(None, t_ns)
        self.present, self.problem = None, None

    def _keep(self, calibration: dict[str, Any] | None, t_ns: int) -> None:
        with storage_errors(self._path):
            make_folder(self._path.parent)
        content = {"t_ns": t_ns, "calibration": calibration}
        write_checked(self._path, json.dumps(content).encode())


def _read(path: Path) -> Assigned | None:
    """What was chosen last; None: it was taken back.

    Raises:
        FileNotFoundError: nothing ever was.
        DamagedFileError: it is not what was written.
        StorageError: it cannot be read now.
    """
    text = read_checked(path).text
    try:
        said = json.loads(text)
        if said["calibration"] is None:
            return None
        content = json.dumps(said["calibration"])
        calibration = Calibration.from_json(content, where=str(path))
        return Assigned(calibration, int(said["t_ns"]))
    except (CalibrationError, ValueError, KeyError, TypeError, RecursionError) as error:
        what = " ".join(str(error).split())[:200]
        raise DamagedFileError(f"no assigned calibration: {what}", where=str(path)) from error
