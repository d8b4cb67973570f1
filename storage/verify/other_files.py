"""Verification of other files in a data folder, beside sessions and journals.

Every JSON file of ours has its own hash (`storage.checksummed_json`), `server_id` a CRC-32. A name
with `.damaged-N` was set aside and is not verified.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from devices.errors import DamagedFileError, StorageError
from storage.checksummed_json import read_checksummed_json
from storage.durable_files import ASIDE_SUFFIX
from storage.server_id import SERVER_ID_NAME, read_server_id


@dataclass
class OtherFilesReport:
    """Findings, each with its path in the data folder.

    Attributes:
        problems: messages of damage.
        set_aside: files that were found damaged before, and wait for a person.
    """

    problems: list[str] = field(default_factory=list)
    set_aside: list[str] = field(default_factory=list)


def verify_json_and_server_id(data_folder: Path, verified_folders: set[Path]) -> OtherFilesReport:
    """Verify `server_id` and every JSON file of a data folder, except in folders done elsewhere.

    Token, locks and other files have no checksum.

    Args:
        data_folder: the data folder.
        verified_folders: folders of streams and sessions; of them only set-aside files are listed.
    """
    found = OtherFilesReport()

    def unreadable(error: OSError) -> None:
        found.problems.append(
            f"{_relative_path(error.filename, data_folder)}: cannot be read: {error.strerror}"
        )

    for place, folders, files in os.walk(data_folder, onerror=unreadable):
        here = Path(place)
        folders.sort()
        is_verified = here in verified_folders
        for name in sorted([*folders, *files]):
            path = here / name
            if ASIDE_SUFFIX in name:
                found.set_aside.append(_relative_path(path, data_folder))
            elif path == data_folder / SERVER_ID_NAME:
                _verify_with(path, name, read_server_id, found)
            elif name.endswith(".json") and not name.startswith(".") and not is_verified:
                verify_checksummed_json(path, _relative_path(path, data_folder), found)
        # A folder that was set aside, or that has the name of a file, is skipped.
        folders[:] = [
            name for name in folders if ASIDE_SUFFIX not in name and not name.endswith(".json")
        ]
        if is_verified:
            folders.clear()
    return found


def verify_checksummed_json(path: Path, name: str, report: OtherFilesReport) -> None:
    """Verify one JSON file, and add any finding under `name`."""
    _verify_with(path, name, read_checksummed_json, report)


def _verify_with(
    path: Path,
    name: str,
    read: Callable[[Path], object],
    found: OtherFilesReport,
) -> None:
    try:
        read(path)
    except FileNotFoundError:
        return  # replaced or deleted meanwhile
    except (DamagedFileError, StorageError) as error:
        found.problems.append(f"{name}: {error.what}")


def _relative_path(path: Path | str, data: Path) -> str:
    return os.path.relpath(path, data)
