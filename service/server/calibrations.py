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
from service.sessions.calibration_file import calibration_of, content_of
from storage.durable import (
    make_folder,
    put_aside,
    read_whole,
    storage_errors,
    sync_folder,
    write_whole,
)

CALIBRATIONS_MAX = 1000
CONTENT_BYTES_MAX = 1 << 20
"""Size limit, that of a message of the link: a node cannot send a longer one either."""
CALIBRATION_ID = re.compile(r"[0-9a-f]{16}")


@dataclass(frozen=True)
class Kept:
    """Facts of a calibration that are kept in memory."""

    id: str
    name: str
    reference: str
    date: str
    serials: tuple[str, ...]
    refused: tuple[str, ...]
    is_assumed: bool
    """True if the scale of any tile is an assumption."""
    is_mounted: bool
    """True if a force plate has shown how its tiles are mounted."""

    @classmethod
    def of(cls, calibration: Calibration) -> Kept:
        """Return the summary of a calibration."""
        return cls(
            id=calibration.id,
            name=calibration.name,
            reference=calibration.reference,
            date=calibration.date,
            serials=tuple(tile.serial for tile in calibration.tiles),
            refused=tuple(calibration.refused),
            is_assumed=any(tile.absolute_scale == "assumed" for tile in calibration.tiles),
            is_mounted=calibration.mounted is not None,
        )


class CalibrationBook:
    """Calibrations of a data folder; a damaged file is set aside and not listed.

    Args:
        folder: folder of the files; created with the first one.

    Raises:
        StorageError: the folder cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._kept: dict[str, Kept] = {}
        self.problems: list[str] = []
        with storage_errors(folder):
            paths = sorted(folder.glob("*.json"))
        for path in paths:
            if not CALIBRATION_ID.fullmatch(path.stem):
                continue
            try:
                calibration = self._read(path.stem)
            except (CalibrationError, FileFormatError) as error:
                self.problems.append(f"a calibration: {put_aside(path, error)}")
            except FootTileError as error:
                self.problems.append(f"a calibration is left out: {error}")
            else:
                self._kept[path.stem] = Kept.of(calibration)

    def all(self) -> list[Kept]:
        """Return the summaries of all calibrations, the newest recordings first."""
        return sorted(self._kept.values(), key=lambda kept: (kept.date, kept.id), reverse=True)

    def get(self, calibration_id: str) -> Calibration:
        """Load a calibration from the disk.

        Raises:
            UnknownError: no calibration has this id.
            StateError: its file is damaged or was deleted.
            StorageError: it cannot be read now.
        """
        if calibration_id not in self._kept:
            raise UnknownError(
                f"no calibration {calibration_id[:80]!r}",
                expected="the id of one that was uploaded or fitted here",
            )
        try:
            return self._read(calibration_id)
        except (CalibrationError, FileFormatError, FileNotFoundError) as error:
            raise StateError(
                f"calibration {calibration_id} is damaged: {error}", remedy="Upload it again"
            ) from error

    def keep(self, calibration: Calibration) -> Kept:
        """Save a calibration atomically; the same content twice is one calibration.

        Raises:
            StateError: the store is full.
            StorageError: it cannot be written.
        """
        summary = Kept.of(calibration)
        if summary.id not in self._kept and len(self._kept) >= CALIBRATIONS_MAX:
            raise StateError(
                f"this server keeps {len(self._kept)} calibrations already",
                remedy="Delete unused ones",
            )
        with storage_errors(self._folder):
            make_folder(self._folder)
        write_whole(self._path(summary.id), content_of(calibration))
        self._kept[summary.id] = summary
        return summary

    def delete(self, calibration_id: str) -> None:
        """Delete a calibration; nodes and sessions that use it have a copy.

        Raises:
            UnknownError: no calibration has this id.
            StorageError: it cannot be deleted.
        """
        if calibration_id not in self._kept:
            raise UnknownError(f"no calibration {calibration_id[:80]!r}")
        path = self._path(calibration_id)
        with storage_errors(path):
            path.unlink(missing_ok=True)
            sync_folder(self._folder)
        del self._kept[calibration_id]

    def _path(self, calibration_id: str) -> Path:
        return self._folder / f"{calibration_id}.json"

    def _read(self, calibration_id: str) -> Calibration:
        path = self._path(calibration_id)
        calibration = calibration_of(read_whole(path), where=str(path))
        if calibration.id != calibration_id:
            raise CalibrationError(f"it is {calibration.id}", where=str(path))
        return calibration
