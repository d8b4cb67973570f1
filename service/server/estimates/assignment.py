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
from storage.checksummed_json import read_checksummed_json, write_checksummed_json
from storage.durable_files import (
    ASIDE_SUFFIX,
    make_synced_folder,
    set_aside_and_describe,
    translate_storage_errors,
)

_LOST = "assign a calibration again, or unassign it"


@dataclass(frozen=True)
class AssignedCalibration:
    """Assigned calibration, and the time of the assignment, server's UTC."""

    calibration: Calibration
    t_ns: int


class CalibrationAssignment:
    """Assignment for one node.

    Args:
        path: file of the assignment.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.current: AssignedCalibration | None = None
        """None: the node's own calibration is used, unless `problem` is set."""
        self.problem: str | None = None
        """Reason why the assignment is unknown; None: it is known, or there is none."""
        try:
            self.current = _read_assignment(path)
        except FileNotFoundError:
            if any(path.parent.glob(path.name + ASIDE_SUFFIX + "*")):
                self.problem = f"the calibration that was assigned is lost: {_LOST}"
        except DamagedFileError as error:
            self.problem = (
                f"the calibration that was assigned is lost ({set_aside_and_describe(path, error)})"
            )
            self.problem += f": {_LOST}"
        except StorageError as error:
            self.problem = f"the calibration that was assigned cannot be read: {error}"

    def store_assignment(self, calibration: Calibration, t_ns: int) -> None:
        """Store a calibration as the assigned one, in place of the present one.

        Raises:
            StorageError: it cannot be stored; the assignment is unchanged.
        """
        self._store({"id": calibration.id, **calibration.model_dump(mode="json")}, t_ns)
        self.current, self.problem = AssignedCalibration(calibration, t_ns), None

    def remove_assignment(self, t_ns: int) -> None:
        """Remove the assignment, on the disk too: the node's own calibration is used again.

        Raises:
            StorageError: that cannot be stored; the assignment is unchanged.
        """
        self._store(None, t_ns)
        self.current, self.problem = None, None

    def _store(self, calibration: dict[str, Any] | None, t_ns: int) -> None:
        with translate_storage_errors(self._path):
            make_synced_folder(self._path.parent)
        content = {"t_ns": t_ns, "calibration": calibration}
        write_checksummed_json(self._path, json.dumps(content).encode())


def _read_assignment(path: Path) -> AssignedCalibration | None:
    """Read the last assignment; None: it was removed.

    Raises:
        FileNotFoundError: there never was one.
        DamagedFileError: the file is damaged.
        StorageError: it cannot be read now.
    """
    text = read_checksummed_json(path)
    try:
        document = json.loads(text)
        if document["calibration"] is None:
            return None
        content = json.dumps(document["calibration"])
        calibration = Calibration.from_json(content, where=str(path))
        return AssignedCalibration(calibration, int(document["t_ns"]))
    except (CalibrationError, ValueError, KeyError, TypeError, RecursionError) as error:
        what = " ".join(str(error).split())[:200]
        raise DamagedFileError(f"no assigned calibration: {what}", where=str(path)) from error
