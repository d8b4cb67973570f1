"""Metadata of a session from `session.json`, the server's own or one of `foottile pull`."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from devices.errors import DamagedFileError, StorageError
from storage.checked_json import is_unchanged, read_checked, without_check
from storage.durable import read_whole
from storage.sessions.folder import Ledger, Part, Session

SESSION_NAME = "session.json"
LEDGER_NAME = "ledger.json"
PULLED_EVENTS_NAME = "events.json"
"""Markers; `foottile pull` writes this file and the ledger's."""


@dataclass(frozen=True)
class Claims:
    """Metadata from a folder's `session.json`, the server's own or a pulled one."""

    content: dict[str, Any]
    parts: tuple[Part, ...]
    ledger: Ledger | None
    whole: Session | None
    """Complete model; None for a pulled session, which has fewer fields."""


def claims_in(
    folder: Path, text: bytes | None, problems: list[str], unproven: list[str]
) -> Claims | None:
    """Parse the metadata of a session's folder and verify its checksum.

    Args:
        folder: folder of the session.
        text: content of its `session.json`; None if it is missing or unreadable.
        problems: messages of damage are added here.
        unproven: descriptions of facts without proof are added here.

    Returns:
        None if it cannot be parsed.
    """
    if text is None:
        is_there = os.path.lexists(folder / SESSION_NAME)
        problems.append(f"{SESSION_NAME} {'cannot be read' if is_there else 'is missing'}")
        return None
    unchanged = is_unchanged(text)
    if unchanged is False:
        problems.append(f"{SESSION_NAME} was changed: its text does not match its hash")
    try:
        if unchanged is None:
            unproven.append(f"name, subject, notes and tags in {SESSION_NAME}: it has no hash")
        body = without_check(text)
        try:
            return claims_of(Session.model_validate_json(body))
        except ValidationError:
            return _pulled(folder, json.loads(body), problems, unproven)
    except (ValueError, KeyError, TypeError) as error:
        problems.append(f"{SESSION_NAME} is not readable: {first_line(error)}")
        return None


def claims_of(session: Session) -> Claims:
    """Return a session's model as metadata."""
    return Claims(session.model_dump(mode="json"), session.parts, session.ledger, session)


def _pulled(
    folder: Path, content: dict[str, Any], problems: list[str], unproven: list[str]
) -> Claims:
    """Parse a pulled session: the API's view of it, and markers and ledger beside it."""
    text = _beside(folder / LEDGER_NAME, problems, unproven)
    _beside(folder / PULLED_EVENTS_NAME, problems, unproven)
    parts = tuple(Part.model_validate(part) for part in content["parts"])
    ledger = Ledger.model_validate_json(text) if text is not None else None
    return Claims({**content, "id": content["id"]}, parts, ledger, None)


def _beside(path: Path, problems: list[str], unproven: list[str]) -> bytes | None:
    try:
        read = read_checked(path)
    except FileNotFoundError:
        return None
    except (DamagedFileError, StorageError) as error:
        problems.append(f"{path.name}: {error.what}")
        return None
    if not read.is_proven:
        unproven.append(f"{path.name}: it has no hash")
    return read.text


def bytes_of(path: Path) -> bytes | None:
    """Read a file's content; None if there is none, or it cannot be read."""
    try:
        return read_whole(path)
    except (OSError, DamagedFileError):
        return None


def first_line(error: Exception) -> str:
    """Return an error's text in one line of up to 300 characters."""
    return " ".join(str(error).split())[:300]
