"""`server_id`: the random name of a server's data folder, with a CRC-32."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

from devices.errors import DamagedFileError
from storage.durable_files import read_small_file, write_atomically

SERVER_ID_NAME = "server_id"
_FORM = re.compile(r"([0-9a-f]{32}) ([0-9a-f]{8})")


def read_existing_server_id(path: Path) -> str:
    """Read the id and verify its CRC-32.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its CRC-32 is wrong or missing.
        StorageError: it cannot be read now.
    """
    text = read_small_file(path).decode("ascii", "replace").strip()
    found = _FORM.fullmatch(text)
    if found is None or found[2] != _crc32_hex(found[1]):
        raise DamagedFileError("it is not the id that was written", where=str(path))
    return found[1]


def write_server_id(path: Path, server_id: str) -> None:
    """Write an id atomically.

    Args:
        path: the file; an existing one is replaced.
        server_id: 32 hexadecimal digits.

    Raises:
        StorageError: the disk is full or not writable.
    """
    write_atomically(path, f"{server_id} {_crc32_hex(server_id)}\n".encode())


def _crc32_hex(server_id: str) -> str:
    return f"{zlib.crc32(server_id.encode()):08x}"
