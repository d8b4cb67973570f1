"""Calibration assigned to a node on the server.

A node sends its own calibration with hello. An assigned one replaces it, from the next frame on and
for sessions that begin then, until it is unassigned; it is a copy, stored with the node. If the
file is damaged, the assigned calibration is unknown: then the node has none, rather than another
one.
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

_LOST = "assign a calibration again, or unassign it"


@dataclass(frozen=True)
class Assigned:
    """Assigned calibration, and the time of the assignment, server's UTC."""

    calibration: Calibration
    t_ns: int


class Assignment:
    """Assignment for one node.

    Args:
        path: file of the assignment.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.present: Assigned | None = None
        """None: the node's own calibration is used, unless `problem` is set."""
        self.problem: str | None = None
        """Reason why the assignment is unknown; None: it is known, or there is none."""
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
        """Assign a calibration.

        Raises:
            StorageError: it cannot be stored; the assignment is unchanged.
        """
        self._keep({"id": calibration.id, **calibration.model_dump(mode="json")}, t_ns)
        self.present, self.problem = Assigned(calibration, t_ns), None

    def take_back(self, t_ns: int) -> None:
        """Remove the assignment: the node's own calibration is used again.

        Raises:
            StorageError: that cannot be stored; the assignment is unchanged.
        """
        self._keep(None, t_ns)
        self.present, self.problem = None, None

    def _keep(self, calibration: dict[str, Any] | None, t_ns: int) -> None:
        with storage_errors(self._path):
            make_folder(self._path.parent)
        content = {"t_ns": t_ns, "calibration": calibration}
        write_checked(self._path, json.dumps(content).encode())


def _read(path: Path) -> Assigned | None:
    """Read the last assignment; None: it was removed.

    Raises:
        FileNotFoundError: there never was one.
        DamagedFileError: the file is damaged.
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
