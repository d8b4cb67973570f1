"""What a crash leaves, made by hand: streams, sessions, and what recovery made of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from devices.frames import ArrayInfo, FrameBatch, FrameStatus
from service.sessions.recover import Recovered, Recovery, recover
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes, unsynced_tail_max
from storage.sessions.folder import Event, Ledger, Part, Session, SessionFolder
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array
from tests.builders.frames import make_frames

ID = "20200101T000000Z-00000a"
BOOT = "a" * 32
OTHER_BOOT = "b" * 32
LEAD = 400
TAIL = unsynced_tail_max(500.0)

Frames = Callable[..., FrameBatch]


def info_of(boot_id: str = BOOT) -> ArrayInfo:
    return make_array(boot_id=boot_id)


def frames(first: int, last: int) -> FrameBatch:
    """Unloaded for the lead, then ten counts, which are ten newtons; the last digit is noise."""
    seq = np.arange(first, last + 1)
    lead = seq < LEAD
    return make_frames(
        seq,
        padc=(np.where(lead, 500, 490) + seq % 2)[:, None],
        frame_status=np.where(lead, FrameStatus.LEAD, 0),
    )


def t_ns(seq: int) -> int:
    return UTC_NS + PERIOD_NS * seq


def stream(
    data: Path, info: ArrayInfo, *runs: tuple[int, int], closed: bool = True, **notes: Any
) -> Path:
    folder = data / "journal" / info.node / info.boot_id
    journal = Journal(folder, info)
    for first, last in runs:
        for begin in range(first, last + 1, 10):
            journal.append(frames(begin, min(begin + 9, last)))
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
        "parts": (Part(boot_id=BOOT, seq_first=0),),
        "scene": "test",
        "scene_content": {"name": "test"},
        "subject": "leg 2",
        "notes": "in mud",
        "tags": ("wet",),
        "events": (Event(id="e1", label="slip", t_ns=t_ns(500)),),
    }
    kept = Session(**content | changes)
    SessionFolder(data / "sessions").save(kept)
    return kept


def loaded(data: Path, session_id: str = ID) -> Session:
    return SessionFolder(data / "sessions").load(session_id)


def recovered(data: Path, **how: Any) -> tuple[Recovered, Ledger]:
    """The one session that is recovered, and what became of its frames."""
    (one,) = recover(data, **how).sessions
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


def outcomes(recovery: Recovery) -> list[str]:
    return [one.outcome for one in recovery.sessions]
