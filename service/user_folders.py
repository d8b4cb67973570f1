"""Folders of the user that a process runs as: named by an option, else where the system has them.

A service may have no home: `docker run --user 12345`, `DynamicUser=` of systemd, an empty
environment.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from devices.errors import UsageError

Kind = Literal["data", "state", "cache"]


def user_folder(kind: Kind, given: Path | None, option: str) -> Path:
    """Return the folder that an option names, or the user's own; it need not be there yet.

    Args:
        kind: of what is kept in it.
        given: value of the option. A leading `~` is the home, which no shell puts in place of it in
            `--data=~/x`, in an environment file or in a unit of systemd.
        option: its name, for the error.

    Raises:
        UsageError: no home is known, or nothing can be written there.
    """
    if given is not None:
        try:
            return given.expanduser()
        except RuntimeError as error:
            raise UsageError(
                f"no home folder is known for {str(given)!r}", remedy="Write the whole path"
            ) from error
    folder = _default(kind)
    if folder is None:
        problem = f"no home folder is known for user {os.getuid()}"
    elif kind != "state" and not _can_be_written(folder):  # a node goes on without a disk
        problem = f"user {os.getuid()} cannot write in {str(folder)!r}"
    else:
        return folder
    raise UsageError(problem, remedy=f"Name a folder with {option}, or in XDG_{kind.upper()}_HOME")


def _default(kind: Kind) -> Path | None:
    """Return the user's folder; None: there is no home, which platformdirs says in two ways."""
    import platformdirs

    of = {
        "data": platformdirs.user_data_path,
        "state": platformdirs.user_state_path,
        "cache": platformdirs.user_cache_path,
    }
    try:
        folder = of[kind]("foottile")
    except RuntimeError:
        return None
    return folder if folder.is_absolute() else None


def _can_be_written(folder: Path) -> bool:
    """Is it there, or can it be made?"""
    if folder.exists():
        return True
    above = next(each for each in folder.parents if each.exists())
    return os.access(above, os.W_OK | os.X_OK)
