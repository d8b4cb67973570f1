"""What a crash leaves, made by hand: streams, sessions, and what recovery made of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from devices.flags import FrameFlag
from devices.frames import ArrayInfo, FrameBatch
from service.sessions.recovery import RecoveredSession, RecoveryReport, recover_locked_folder
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes, compute_max_lost_tail_frames
from storage.sessions.folder import Ledger, Marker, Part, Session, SessionsFolder
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array
from tests.builders.frames import make_frames

ID = "20200101T000000Z-00000a"
BOOT = "a" * 32
OTHER_BOOT = "b" * 32
LEAD = 400
TAIL = compute_max_lost_tail_frames(500.0)

Frames = Callable[..., FrameBatch]


def info_of(stream_id: str = BOOT) -> ArrayInfo:
    return make_array(stream_id=stream_id)


def frames(first: int, last: int) -> FrameBatch:
    """Unloaded for the lead, then ten counts, which are ten newtons; the last digit is noise."""
    seq = np.arange(first, last + 1)
    lead = seq < LEAD
    return make_frames(
        seq,
        pressure_raw=(np.where(lead, 500, 490) + seq % 2)[:, None],
        frame_flags=np.where(lead, FrameFlag.LEAD, 0),
    )


def t_ns(seq: int) -> int:
    return UTC_NS + PERIOD_NS * seq


def stream(
    data: Path, info: ArrayInfo, *runs: tuple[int, int], closed: bool = True, **notes: Any
) -> Path:
    folder = data / "journal" / info.node / info.stream_id
    journal = Journal(folder, info)
    for first, last in runs:
        for begin in range(first, last + 1, 10):
            journal.append_new_frames(frames(begin, min(begin + 9, last)))
    StreamNotes(array_info=info, **notes).save(folder)
    journal.close()
    if not closed:  # as a killed process leaves it
        for path in folder.glob("*.idx"):
            path.write_bytes(path.read_bytes()[:-48])
    return folder


def session(data: Path, session_id: str = ID, **changes: Any) -> Session:
    content: dict[str, Any] = {
        "id": session_id,
        "name": "walk",
        "node": "bench",
        "state": "recording",
        "started_t_ns": t_ns(0),
        "parts": (Part(stream_id=BOOT, seq_first=0),),
        "scene": "test",
        "scene_content": {"name": "test"},
        "subject": "leg 2",
        "notes": "in mud",
        "tags": ("wet",),
        "markers": (Marker(id="e1", label="slip", t_ns=t_ns(500)),),
    }
    kept = Session(**content | changes)
    SessionsFolder(data / "sessions").save_session_json(kept)
    return kept


def loaded(data: Path, session_id: str = ID) -> Session:
    return SessionsFolder(data / "sessions").load(session_id)


def recovered(data: Path, **how: Any) -> tuple[RecoveredSession, Ledger]:
    """The one session that is recovered, and what became of its frames."""
    (one,) = recover_locked_folder(data, **how).sessions
    assert one.ledger is not None
    return one, one.ledger


def state_of(data: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(data)): path.read_bytes()
        for path in sorted(data.rglob("*"))
        if path.is_file()
    }


def servers(data: Path) -> Path:
    (data / "nodes" / "bench").mkdir(parents=True)
    return data


def outcomes(recovery: RecoveryReport) -> list[str]:
    return [one.outcome for one in recovery.sessions]
