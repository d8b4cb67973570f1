"""The calibrations that a server keeps, by id: what was uploaded, and what was fitted here.

An id is the hash of the content, so none is ever changed: another content is another calibration.
What uses one has a copy of its own, so that one may be deleted at any time.
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
"""As long as a message of the link: a longer one could not come from a node either."""
CALIBRATION_ID = re.compile(r"[0-9a-f]{16}")


@dataclass(frozen=True)
class Kept:
    """What is known of one without reading it again."""

    id: str
    name: str
    reference: str
    date: str
    serials: tuple[str, ...]
    refused: tuple[str, ...]
    is_assumed: bool
    """Is the scale of any tile an assumption?"""
    is_mounted: bool
    """Has a plate shown how its tiles are mounted?"""

    @classmethod
    def of(cls, calibration: Calibration) -> Kept:
        """In short."""
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
    """The calibrations of a data folder; one that is damaged is set aside, and not listed.

    Args:
        folder: where they are; made when the first one is kept.

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
        """All of them, the newest recordings first."""
        return sorted(self._kept.values(), key=lambda kept: (kept.date, kept.id), reverse=True)

    def get(self, calibration_id: str) -> Calibration:
        """One of them, from the disk.

        Raises:
            UnknownError: there is none of this id.
            StateError: its file is damaged, or has been taken away.
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
        """Keep one, whole or not at all; the same content twice is one calibration.

        Raises:
            StateError: there are too many.
            StorageError: it cannot be written.
        """
        kept = Kept.of(calibration)
        if kept.id not in self._kept and len(self._kept) >= CALIBRATIONS_MAX:
            raise StateError(
                f"this server keeps {len(self._kept)} calibrations already",
                remedy="Delete some that nobody needs",
            )
        with storage_errors(self._folder):
            make_folder(self._folder)
        write_whole(self._path(kept.id), content_of(calibration))
        self._kept[kept.id] = kept
        return kept

    def delete(self, calibration_id: str) -> None:
        """Delete one; nodes and sessions that use it have it still.

        Raises:
            UnknownError: there is none of this id.
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
