"""`secrets.json`: secrets that two machines share, by the other machine's name.

A server keeps one in the folder of each node, a node one in its own folder. No other user may read
it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

from devices.errors import DamagedFileError
from storage.checksummed_json import read_checksummed_json, write_checksummed_json
from storage.durable_files import make_synced_folder, translate_storage_errors

SECRETS_NAME = "secrets.json"
_SECRET = re.compile(r"[0-9a-f]{64}")
_OWNER_ONLY = 0o600
"""File permissions, also in a folder that its owner has opened to a group."""


def read_secrets_or_empty(path: Path) -> dict[str, str]:
    """Return the secrets by name, 64 hex digits each; empty if there is no file.

    Raises:
        DamagedFileError: its content has changed since it was written.
        StorageError: it cannot be read now.
    """
    try:
        content = json.loads(read_checksummed_json(path))
    except FileNotFoundError:
        return {}
    found = content.get("secrets") if isinstance(content, dict) else None
    if not isinstance(found, dict) or not all(
        isinstance(secret, str) and _SECRET.fullmatch(secret) for secret in found.values()
    ):
        raise DamagedFileError(
            "it holds no secrets", where=str(path), expected="64 hex digits by name"
        )
    return found


def write_secrets(path: Path, secrets: Mapping[str, str]) -> None:
    """Write the secrets atomically; they are on the disk when this returns.

    Raises:
        StorageError: the disk is full or not writable; the old file is unchanged.
    """
    with translate_storage_errors(path.parent):
        make_synced_folder(path.parent)
    text = json.dumps({"secrets": dict(secrets)}).encode()
    write_checksummed_json(path, text, mode=_OWNER_ONLY)
