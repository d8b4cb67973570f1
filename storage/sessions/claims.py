"""What `session.json` says of a session: the server's own, or the one that `foottile pull` left."""

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
"""`foottile pull` writes these two."""


@dataclass(frozen=True)
class Claims:
    """What a folder's `session.json` says, the server's own or one that was pulled."""

    content: dict[str, Any]
    parts: tuple[Part, ...]
    ledger: Ledger | None
    whole: Session | None
    """None for a pulled session, which says less."""


def claims_in(
    folder: Path, text: bytes | None, problems: list[str], unproven: list[str]
) -> Claims | None:
    """What a session's folder says of itself.

    Args:
        folder: the session's.
        text: of its `session.json`; None if that is missing, or cannot be read.
        problems: what is wrong is added here.
        unproven: and here what the text cannot show.

    Returns:
        None if it is not readable.
    """
    if text is None:
        is_there = os.path.lexists(folder / SESSION_NAME)
        problems.append(f"{SESSION_NAME} {'cannot be read' if is_there else 'is missing'}")
        return None
    unchanged = is_unchanged(text)
    if unchanged is False:
        problems.append(f"{SESSION_NAME} was changed: its text is not what its hash is of")
    try:
        if unchanged is None:
            unproven.append(
                f"name, subject, notes and tags in {SESSION_NAME}: it states no hash of itself"
            )
        body = without_check(text)
        try:
            return claims_of(Session.model_validate_json(body))
        except ValidationError:
            return _pulled(folder, json.loads(body), problems, unproven)
    except (ValueError, KeyError, TypeError) as error:
        problems.append(f"{SESSION_NAME} is not readable: {first_line(error)}")
        return None


def claims_of(session: Session) -> Claims:
    """What a session says."""
    return Claims(session.model_dump(mode="json"), session.parts, session.ledger, session)


def _pulled(
    folder: Path, content: dict[str, Any], problems: list[str], unproven: list[str]
) -> Claims:
    """What `foottile pull` left: the API's view of the session, and beside it events and ledger."""
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
        unproven.append(f"{path.name}: it states no hash of itself")
    return read.text


def bytes_of(path: Path) -> bytes | None:
    """A file's content; None if there is none, or it cannot be read."""
    try:
        return read_whole(path)
    except (OSError, DamagedFileError):
        return None


def first_line(error: Exception) -> str:
    """An error in one line of bounded length."""
    return " ".join(str(error).split())[:300]
