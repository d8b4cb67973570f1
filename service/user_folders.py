"""Folders of the process's user, and the removal of private paths from messages to clients.

A service may have no home: `docker run --user 12345`, `DynamicUser=` of systemd, an empty
environment.

A server registers its data folder. In its messages paths are relative to that folder; its log and
local commands show whole paths.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator

from devices.errors import UsageError, escape_control_chars

FolderKind = Literal["data", "state", "cache"]


def resolve_user_folder(kind: FolderKind, option_value: Path | None, option_name: str) -> Path:
    """Return the folder that an option names, else the user's default; it need not exist.

    Args:
        kind: kind of its content.
        option_value: value of the option. A leading `~` is replaced by the home, as shells do not
            do that in `--data=~/x`, in an environment file or in a unit of systemd.
        option_name: name of the option, for the error.

    Raises:
        UsageError: no home is known, or the folder cannot be written.
    """
    if option_value is not None:
        try:
            return option_value.expanduser()
        except RuntimeError as error:
            raise UsageError(
                f"no home folder is known for {str(option_value)!r}", remedy="Write the whole path"
            ) from error
    folder = _default_folder(kind)
    if folder is None:
        problem = f"no home folder is known for user {os.getuid()}"
    elif kind != "state" and not _is_writable(folder):  # a node goes on without a disk
        problem = f"user {os.getuid()} cannot write in {str(folder)!r}"
    else:
        return folder
    raise UsageError(
        problem, remedy=f"Name a folder with {option_name}, or in XDG_{kind.upper()}_HOME"
    )


def _default_folder(kind: FolderKind) -> Path | None:
    """Return the user's default folder; None without a home."""
    import platformdirs

    default_of = {
        "data": platformdirs.user_data_path,
        "state": platformdirs.user_state_path,
        "cache": platformdirs.user_cache_path,
    }
    try:
        folder = default_of[kind]("foottile")
    except RuntimeError:
        return None
    # Without a home platformdirs raises, or returns a relative path.
    return folder if folder.is_absolute() else None


def _is_writable(folder: Path) -> bool:
    """Return whether the folder exists or can be created."""
    if folder.exists():
        return True
    above = next(each for each in folder.parents if each.exists())
    return os.access(above, os.W_OK | os.X_OK)


_folders: list[str] = []
"""Spellings of private folders, longest first."""


def register_private_folder(folder: Path) -> None:
    """Register a folder, to be removed by `strip_private_folders`."""
    for path in (folder, folder.absolute(), folder.resolve()):
        for text in (str(path), escape_control_chars(str(path))):
            if len(text) > 1 and text not in _folders:  # "/" and "." are in every path
                _folders.append(text)
    _folders.sort(key=len, reverse=True)


def strip_private_folders(text: str) -> str:
    """Return a message with paths relative to the registered folders."""
    for folder in _folders:
        if folder in text:
            text = text.replace(f"{folder}/", "").replace(folder, "the data folder")
    return text


def _escape_surrogates(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()


PublicText = Annotated[
    str, AfterValidator(strip_private_folders), AfterValidator(_escape_surrogates)
]
"""Message of a server without private paths; file names that are not UTF-8 are escaped."""
