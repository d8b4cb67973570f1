"""Removal of private paths of this machine from messages to clients.

A server registers its data folder. In its messages paths are relative to that folder; its log and
local commands show whole paths.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from devices.text import escape_control_chars

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


PublicText = Annotated[str, AfterValidator(strip_private_folders)]
"""Message of a server without private paths."""
