"""`server_id`: the random name of a server's data folder, with a CRC-32."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from pathlib import Path

from devices.errors import DamagedFileError
from storage.durable import read_whole, write_whole

SERVER_ID_NAME = "server_id"
_FORM = re.compile(r"([0-9a-f]{32})(?: ([0-9a-f]{8}))?")


@dataclass(frozen=True)
class ServerId:
    """Content of the file."""

    id: str
    is_proven: bool
    """False: an older version wrote it without a CRC-32."""


def read_server_id(path: Path) -> ServerId:
    """Read the id and verify its CRC-32.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its CRC-32 is wrong.
        StorageError: it cannot be read now.
    """
    text = read_whole(path).decode("ascii", "replace").strip()
    found = _FORM.fullmatch(text)
    if found is None or found[2] not in (None, _check_of(found[1])):
        raise DamagedFileError("it is not the id that was written", where=str(path))
    return ServerId(found[1], is_proven=found[2] is not None)


def write_server_id(path: Path, made: str) -> None:
    """Write an id atomically.

    Args:
        path: the file; an existing one is replaced.
        made: 32 hexadecimal digits.

    Raises:
        StorageError: the disk is full or not writable.
    """
    write_whole(path, f"{made} {_check_of(made)}\n".encode())


def _check_of(made: str) -> str:
    return f"{zlib.crc32(made.encode()):08x}"
