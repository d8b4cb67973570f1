"""Metadata of a session from `session.json`, the server's own or one of `foottile pull`."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from devices.errors import DamagedFileError, StorageError
from storage.checksummed_json import read_checksummed_json, verify_and_strip_json_checksum
from storage.durable_files import read_small_file
from storage.sessions.folder import Ledger, Part, Session

SESSION_NAME = "session.json"
LEDGER_NAME = "ledger.json"
PULLED_MARKERS_NAME = "markers.json"
"""Markers; `foottile pull` writes this file and the ledger's."""


@dataclass(frozen=True)
class StoredMetadata:
    """Metadata from a folder's `session.json`, the server's own or a pulled one."""

    content: dict[str, Any]
    parts: tuple[Part, ...]
    ledger: Ledger | None
    session: Session | None
    """Complete model; None for a pulled session, which has fewer fields."""


def parse_session_metadata(
    folder: Path, session_json: bytes | None, problems: list[str]
) -> StoredMetadata | None:
    """Parse the metadata of a session's folder and verify its checksum.

    Args:
        folder: folder of the session.
        session_json: content of its `session.json`; None if it is missing or unreadable.
        problems: messages of damage are added here.

    Returns:
        None if it cannot be parsed.
    """
    if session_json is None:
        is_there = os.path.lexists(folder / SESSION_NAME)
        problems.append(f"{SESSION_NAME} {'cannot be read' if is_there else 'is missing'}")
        return None
    try:
        body = verify_and_strip_json_checksum(session_json, where=SESSION_NAME)
        try:
            return make_session_metadata(Session.model_validate_json(body))
        except ValidationError:
            return _parse_pulled_metadata(folder, json.loads(body), problems)
    except DamagedFileError as error:
        problems.append(f"{SESSION_NAME}: {error.what}")
        return None
    except (ValueError, KeyError, TypeError) as error:
        problems.append(f"{SESSION_NAME} is not readable: {shorten_error(error)}")
        return None


def make_session_metadata(session: Session) -> StoredMetadata:
    """Return a session's model as metadata."""
    return StoredMetadata(session.model_dump(mode="json"), session.parts, session.ledger, session)


def _parse_pulled_metadata(
    folder: Path, content: dict[str, Any], problems: list[str]
) -> StoredMetadata:
    """Parse a pulled session: the API's view of it, and markers and ledger beside it."""
    text = _read_sidecar_json(folder / LEDGER_NAME, problems)
    _read_sidecar_json(folder / PULLED_MARKERS_NAME, problems)
    parts = tuple(Part.model_validate(part) for part in content["parts"])
    ledger = Ledger.model_validate_json(text) if text is not None else None
    return StoredMetadata({**content, "id": content["id"]}, parts, ledger, None)


def _read_sidecar_json(path: Path, problems: list[str]) -> bytes | None:
    try:
        return read_checksummed_json(path)
    except FileNotFoundError:
        return None
    except (DamagedFileError, StorageError) as error:
        problems.append(f"{path.name}: {error.what}")
        return None


def read_bytes_or_none(path: Path) -> bytes | None:
    """Read a file's content; None if there is none, or it cannot be read."""
    try:
        return read_small_file(path)
    except (OSError, DamagedFileError):
        return None


def shorten_error(error: Exception) -> str:
    """Return an error's text in one line of up to 300 characters."""
    return " ".join(str(error).split())[:300]
