"""Folders of sessions beside the journals they came from, whole and edited."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from devices.frames import ArrayInfo, FrameBatch
from service.sessions.inputs import SessionInputs
from service.sessions.sealing import seal_session
from storage.checksummed_json import append_json_checksum
from storage.clock.log import ClockOffset
from storage.intervals import Losses
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes
from storage.sessions.folder import Marker, Part, Session, SessionsFolder
from storage.sessions.ledger import StreamState, compute_ledger
from storage.verify.session import verify_session
from tests.builders.arrays import UTC_NS, make_array
from tests.builders.frames import make_frames

ID = "20200101T000000Z-00000a"
OTHER_ID = "20200101T000000Z-00000b"
STREAM_IDS = ("a" * 32, "b" * 32)
EVENTS = (Marker(id="e1", label="slip", t_ns=UTC_NS + 5),)


def array(boot: int = 0) -> ArrayInfo:
    return make_array(1, stream_id=STREAM_IDS[boot], utc_offset_ns=UTC_NS + boot)


def frames(first: int, last: int, boot: int = 0) -> FrameBatch:
    return make_frames(np.arange(first, last + 1), 1, utc_offset_ns=UTC_NS + boot)


def journal(data: Path, boot: int, *runs: tuple[int, int], **notes: Any) -> Journal:
    folder = data / "journal" / "bench" / STREAM_IDS[boot]
    held = Journal(folder, array(boot))
    for first, last in runs:
        for begin in range(first, last + 1, 5):
            held.append_new_frames(frames(begin, min(begin + 4, last), boot))
    held.close()
    StreamNotes(array_info=array(boot), **notes).save(folder)
    return held


def session(session_id: str = ID, **changes: Any) -> Session:
    content: dict[str, Any] = {
        "id": session_id,
        "name": "walk",
        "node": "bench",
        "state": "sealing",
        "started_t_ns": UTC_NS,
        "stopped_t_ns": UTC_NS + 10**9,
        "parts": (
            Part(stream_id=STREAM_IDS[0], seq_first=10, seq_last=49),
            Part(stream_id=STREAM_IDS[1], seq_first=0, seq_last=19),
        ),
        "scene": "test",
        "notes": "first try",
        "markers": EVENTS,
        "clock": (
            ClockOffset(
                stream_id=STREAM_IDS[0], t_mono_ns=1, server_minus_node_ns=2, uncertainty_ns=3
            ),
        ),
    }
    return Session(**content | changes)


def keep(data: Path, kept: Session, *, place: str = "sessions") -> Path:
    """As a server keeps it, with the hash of its own text."""
    SessionsFolder(data / place).save_session_json(kept)
    return data / place / kept.id


def sealed(data: Path, session_id: str = ID, **changes: Any) -> Path:
    """A sealed session of two parts, of which frames 20 to 24 of the first are lost."""
    begun = session(session_id, **changes)
    journals = {
        STREAM_IDS[0]: journal(data, 0, (0, 19), (25, 60)),
        STREAM_IDS[1]: journal(data, 1, (0, 19)),
    }
    lost = {STREAM_IDS[0]: Losses({"disk_full": [(20, 24)]})}
    states = {
        stream_id: StreamState(stored=held.stored, lost=lost.get(stream_id, Losses()))
        for stream_id, held in journals.items()
    }
    ledger = compute_ledger(begun.parts, states, has_all_parts=True)
    notes = {"lost": {stream_id: losses.to_pairs() for stream_id, losses in lost.items()}}
    folder = keep(data, begun)
    done = seal_session(
        SessionInputs(begun, array(), journals, None, "none", (), notes), folder, ledger
    )
    return keep(data, done)


def problems(folder: Path) -> str:
    return "; ".join(verify_session(folder).problems)


def edited(folder: Path, change: Any) -> None:
    path = folder / "session.json"
    content = json.loads(path.read_bytes())
    content.pop("check", None)
    change(content)
    path.write_bytes(append_json_checksum(json.dumps(content).encode()))


def raised(name: str, value: Any) -> Any:
    def change(content: dict[str, Any]) -> None:
        content[name] = value

    return change


def in_ledger(name: str, value: Any) -> Any:
    def change(content: dict[str, Any]) -> None:
        content["ledger"]["parts"][0][name] = value

    return change
