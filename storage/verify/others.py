"""Verification of other files in a data folder, beside sessions and journals.

Every JSON file of ours has its own hash (`storage.checked_json`), `server_id` a CRC-32. A name
with `.damaged-N` was set aside and is not verified.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from devices.errors import DamagedFileError, StorageError
from storage.checked_json import Checked, read_checked
from storage.durable import ASIDE
from storage.server_id import SERVER_ID_NAME, ServerId, read_server_id


@dataclass
class Others:
    """Findings, each with its path in the data folder.

    Attributes:
        problems: messages of damage.
        unproven: files without a hash.
        set_aside: files that were found damaged before, and wait for a person.
    """

    problems: list[str] = field(default_factory=list)
    unproven: list[str] = field(default_factory=list)
    set_aside: list[str] = field(default_factory=list)


def verify_others(data: Path, proven: set[Path]) -> Others:
    """Verify `server_id` and every JSON file of a data folder, except in folders done elsewhere.

    Token, locks and other files have no checksum.

    Args:
        data: the data folder.
        proven: folders of streams and sessions; of them only set-aside files are listed.
    """
    found = Others()

    def unreadable(error: OSError) -> None:
        found.problems.append(f"{_name(error.filename, data)}: cannot be read: {error.strerror}")

    for place, folders, files in os.walk(data, onerror=unreadable):
        here = Path(place)
        folders.sort()
        is_proven = here in proven
        for name in sorted([*folders, *files]):
            path = here / name
            if ASIDE in name:
                found.set_aside.append(_name(path, data))
            elif path == data / SERVER_ID_NAME:
                _check(path, name, read_server_id, found)
            elif name.endswith(".json") and not name.startswith(".") and not is_proven:
                check_json(path, _name(path, data), found)
        # A folder that was set aside, or that has the name of a file, is skipped.
        folders[:] = [name for name in folders if ASIDE not in name and not name.endswith(".json")]
        if is_proven:
            folders.clear()
    return found


def check_json(path: Path, name: str, found: Others) -> None:
    """Verify one JSON file, and add any finding under `name`."""
    _check(path, name, read_checked, found)


def _check(
    path: Path, name: str, read: Callable[[Path], Checked | ServerId], found: Others
) -> None:
    try:
        if not read(path).is_proven:
            found.unproven.append(f"{name}: it has no hash")
    except FileNotFoundError:
        return  # replaced or deleted meanwhile
    except (DamagedFileError, StorageError) as error:
        found.problems.append(f"{name}: {error.what}")


def _name(path: Path | str, data: Path) -> str:
    return os.path.relpath(path, data)
