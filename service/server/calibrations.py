"""Store of a server's calibrations, uploaded or fitted here, by id.

An id is the hash of the content, so a calibration never changes: other content is another
calibration. Nodes and sessions copy the one they use, so a calibration may be deleted at any time.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from devices.errors import (
    CalibrationError,
    FileFormatError,
    FootTileError,
    StateError,
    UnknownError,
)
from service.estimation.calibration import Calibration
from service.sessions.calibration_file import encode_calibration, parse_calibration
from storage.durable_files import (
    make_synced_folder,
    read_small_file,
    set_aside_and_describe,
    sync_folder,
    translate_storage_errors,
    write_atomically,
)

CALIBRATIONS_MAX = 1000
CONTENT_BYTES_MAX = 1 << 20
"""Size limit, that of a message of the link: a node cannot send a longer one either."""
CALIBRATION_ID = re.compile(r"[0-9a-f]{16}")


@dataclass(frozen=True)
class CalibrationSummary:
    """Facts of a calibration that are kept in memory."""

    id: str
    name: str
    reference: str
    date: str
    serials: tuple[str, ...]
    refused: tuple[str, ...]
    has_assumed_scale: bool
    """True if the scale of any tile is an assumption."""
    has_mount_gains: bool
    """True if a force plate has shown how its tiles are mounted."""

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> CalibrationSummary:
        """Return the summary of a calibration."""
        return cls(
            id=calibration.id,
            name=calibration.name,
            reference=calibration.reference,
            date=calibration.date,
            serials=tuple(tile.serial for tile in calibration.tiles),
            refused=tuple(calibration.refused),
            has_assumed_scale=any(tile.absolute_scale == "assumed" for tile in calibration.tiles),
            has_mount_gains=calibration.mounted is not None,
        )


class CalibrationStore:
    """Calibrations of a data folder; a damaged file is set aside and not listed.

    Args:
        folder: folder of the files; created with the first one.

    Raises:
        StorageError: the folder cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._summaries: dict[str, CalibrationSummary] = {}
        self.problems: list[str] = []
        with translate_storage_errors(folder):
            paths = sorted(folder.glob("*.json"))
        for path in paths:
            if not CALIBRATION_ID.fullmatch(path.stem):
                continue
            try:
                calibration = self._read_file(path.stem)
            except (CalibrationError, FileFormatError) as error:
                self.problems.append(f"a calibration: {set_aside_and_describe(path, error)}")
            except FootTileError as error:
                self.problems.append(f"a calibration is left out: {error}")
            else:
                self._summaries[path.stem] = CalibrationSummary.from_calibration(calibration)

    def list_all(self) -> list[CalibrationSummary]:
        """Return the summaries of all calibrations, the newest recordings first."""
        return sorted(self._summaries.values(), key=lambda kept: (kept.date, kept.id), reverse=True)

    def load(self, calibration_id: str) -> Calibration:
        """Load a calibration from the disk.

        Raises:
            UnknownError: no calibration has this id.
            StateError: its file is damaged or was deleted.
            StorageError: it cannot be read now.
        """
        if calibration_id not in self._summaries:
            raise UnknownError(
                f"no calibration {calibration_id[:80]!r}",
                expected="the id of one that was uploaded or fitted here",
            )
        try:
            return self._read_file(calibration_id)
        except (CalibrationError, FileFormatError, FileNotFoundError) as error:
            raise StateError(
                f"calibration {calibration_id} is damaged: {error}", remedy="Upload it again"
            ) from error

    def save(self, calibration: Calibration) -> CalibrationSummary:
        """Save a calibration atomically; the same content twice is one calibration.

        Raises:
            StateError: the store is full.
            StorageError: it cannot be written.
        """
        summary = CalibrationSummary.from_calibration(calibration)
        if summary.id not in self._summaries and len(self._summaries) >= CALIBRATIONS_MAX:
            raise StateError(
                f"this server keeps {len(self._summaries)} calibrations already",
                remedy="Delete unused ones",
            )
        with translate_storage_errors(self._folder):
            make_synced_folder(self._folder)
        write_atomically(self._path(summary.id), encode_calibration(calibration))
        self._summaries[summary.id] = summary
        return summary

    def delete(self, calibration_id: str) -> None:
        """Delete a calibration; nodes and sessions that use it have a copy.

        Raises:
            UnknownError: no calibration has this id.
            StorageError: it cannot be deleted.
        """
        if calibration_id not in self._summaries:
            raise UnknownError(f"no calibration {calibration_id[:80]!r}")
        path = self._path(calibration_id)
        with translate_storage_errors(path):
            path.unlink(missing_ok=True)
            sync_folder(self._folder)
        del self._summaries[calibration_id]

    def _path(self, calibration_id: str) -> Path:
        return self._folder / f"{calibration_id}.json"

    def _read_file(self, calibration_id: str) -> Calibration:
        path = self._path(calibration_id)
        calibration = parse_calibration(read_small_file(path), where=str(path))
        if calibration.id != calibration_id:
            raise CalibrationError(f"it is {calibration.id}", where=str(path))
        return calibration
