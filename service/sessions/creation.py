"""Creation of sessions: by a command, or to continue one whose array has changed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, Literal, NamedTuple

from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.server_clock import server_utc_ns
from storage.sessions.folder import Part, Session, make_session_id


def create_session(
    info: ArrayInfo,
    name: str,
    part: Part,
    *,
    scene_content: Mapping[str, Any],
    calibration: Calibration | None,
    **fields: Any,
) -> Session:
    """Create a session that begins now.

    Args:
        info: array of its first part.
        name: user-given name.
        part: first part.
        scene_content: content of the node's scene file.
        calibration: calibration in use at the beginning.
        fields: further fields of a session, or other values of the above.
    """
    facts: dict[str, Any] = {
        "id": make_session_id(datetime.now(UTC)),
        "name": name,
        "node": info.node,
        "state": "recording",
        "started_t_ns": server_utc_ns(),
        "parts": (part,),
        "scene": info.scene,
        "scene_content": dict(scene_content),
        "calibration": calibration.model_dump(mode="json") if calibration is not None else None,
    }
    return Session(**facts | fields)


class ContinuedSession(NamedTuple):
    """Session whose tiles have changed, in two."""

    closed: Session
    continuation: Session


def continue_session(
    session: Session,
    info: ArrayInfo,
    begin_t_ns: int,
    *,
    scene_content: Mapping[str, Any],
    calibration: Calibration | None,
    calibration_source: Literal["node", "server"] = "node",
) -> ContinuedSession:
    """Return a session whose tiles have changed, closed, and its continuation.

    A file describes one array, so the recording goes on in another session.

    Args:
        session: session whose last part is closed.
        info: present array of the node.
        begin_t_ns: begin of its stream, by the clock that gives the times of stops.
        scene_content: content of the node's scene file.
        calibration: calibration of the present tiles.
        calibration_source: origin of the calibration.
    """
    problem = "the node came back with other tiles: recording ended"
    update: dict[str, object] = {"problem": problem}
    if session.state == "recording":
        update |= {"state": "pending", "stopped_t_ns": begin_t_ns}
    name, number = split_number(session.name)
    continuation = create_session(
        info,
        f"{name} ({number + 1})",
        Part(stream_id=info.stream_id, seq_first=0),
        scene_content=scene_content,
        calibration=calibration,
        calibration_source=calibration_source,
        state=session.state,
        started_t_ns=begin_t_ns,
        stopped_t_ns=session.stopped_t_ns,
        continues=session.id,
        **{field: getattr(session, field) for field in ("subject", "notes", "tags", "take")},
    )
    return ContinuedSession(session.model_copy(update=update), continuation)


class NumberedName(NamedTuple):
    """Name of a session as given, and its number: 2 for `mud (2)`, else 1."""

    given: str
    number: int


def split_number(name: str) -> NumberedName:
    """Split a session's name into the given name and its number."""
    match = re.fullmatch(r"(.*) \((\d+)\)", name)
    return NumberedName(match[1], int(match[2])) if match else NumberedName(name, 1)
