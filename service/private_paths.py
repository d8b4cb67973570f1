"""Paths of this machine, which are nobody's business who only may read what a server shows.

A server registers its data folder. In what it sends, paths below it begin there; its log and local
commands name them whole.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from devices.words import printable

_folders: list[str] = []
"""Longest first, as they may be written in a message."""


def register_folder(folder: Path) -> None:
    """Have `without_folders` leave out this folder from now on."""
    for path in (folder, folder.absolute(), folder.resolve()):
        for text in (str(path), printable(str(path))):
            if len(text) > 1 and text not in _folders:  # "/" and "." are in every path
                _folders.append(text)
    _folders.sort(key=len, reverse=True)


def without_folders(text: str) -> str:
    """Return a message in which paths begin at the data folder, as anybody may read it."""
    for folder in _folders:
        if folder in text:
            text = text.replace(f"{folder}/", "").replace(folder, "the data folder")
    return text


ShownText = Annotated[str, AfterValidator(without_folders)]
"""A message that a server sends: what is wrong, what to do."""
