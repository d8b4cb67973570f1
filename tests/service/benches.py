"""A bench recording as a server has one: frames without notes of the mill, its steps as marks."""

from __future__ import annotations

import uuid
from pathlib import Path

import numpy as np

from devices.scene.file import build_scene
from service.offline.calibrations import bench_scene
from service.offline.simulate import SimulateOptions, simulate
from service.rig.emulated import EmulatedFoot
from service.version import SOFTWARE
from storage.clock.file import CLOCK_NAME, write_clock
from storage.clock.log import ClockOffset
from storage.clock.table import StreamFacts
from storage.file_hash import sha256_of
from storage.sessions.beside import write_events
from storage.sessions.file import SessionWriter
from storage.sessions.folder import (
    FRAMES_NAME,
    Event,
    Ledger,
    Part,
    PartLedger,
    Session,
    SessionFolder,
)
from storage.sessions.reader import SessionReader

SESSION_ID = "20260101T000000Z-be5c00"
OFFSET_NS = 3_000_000_000
"""The server's clock less the node's."""


def pressed(cache: Path) -> Path:
    """Tile T01, pressed twice and slowly, then held, with the mill's notes; made once."""
    kept = cache / f"{SOFTWARE}-strokes-T01.parquet"
    if not kept.exists():
        scene = bench_scene("T01").model_dump()
        scene["ground"] |= {"repeats": 2, "stroke_s": 1.5}
        made = cache / f"{uuid.uuid4().hex}.parquet"
        short = build_scene(scene, where="a short bench")
        simulate(SimulateOptions(short, foot=EmulatedFoot(), seconds=9.0), made, None)
        made.rename(kept)
    return kept


def steps_of(pressed_tile: np.ndarray, phase: np.ndarray, t_ns: np.ndarray) -> list[Event]:
    """A mark wherever what is done becomes something else, as a controller would make it."""
    said = [
        ("soak" if what == "soak" else "end") if tile is None else f"{tile} {what}"
        for tile, what in zip(pressed_tile, phase, strict=True)
    ]
    begins = [i for i, text in enumerate(said) if i == 0 or said[i - 1] != text]
    return [Event(id=f"{i:012x}", label=said[i], t_ns=int(t_ns[i]) + OFFSET_NS) for i in begins]


def put(recording: Path, data: Path, *, marked: bool = True) -> Path:
    """Put it into a server's data folder as a sealed session; its folder."""
    sessions = SessionFolder(data / "sessions")
    folder = sessions.path(SESSION_ID)
    folder.mkdir(parents=True)
    with SessionReader(recording) as reader:
        pieces = list(reader.batches("pressed_tile", "phase"))
        info = reader.info
        last = reader.frame_count - 1
        part = Part(boot_id=info.boot_id, seq_first=0, seq_last=last)
        about = {"id": SESSION_ID, "parts": [part.model_dump()]}
        with SessionWriter(folder / FRAMES_NAME, info, {"session": about}) as writer:
            for frames, _ in pieces:
                writer.append(frames, {})
    steps = steps_of(
        np.concatenate([extra["pressed_tile"] for _, extra in pieces]),
        np.concatenate([extra["phase"] for _, extra in pieces]),
        np.concatenate([frames.t_ns for frames, _ in pieces]),
    )
    remark = Event(id="f" * 12, label="the window is open", t_ns=steps[0].t_ns)
    frames_path = folder / FRAMES_NAME
    session = Session(
        id=SESSION_ID,
        name="bench",
        node="bench",
        state="sealed",
        started_t_ns=steps[0].t_ns,
        stopped_t_ns=steps[-1].t_ns,
        parts=(part,),
        scene="indentation",
        events=(remark, *(reversed(steps) if marked else ())),
        frames=last + 1,
        sha256=sha256_of(frames_path),
        bytes=frames_path.stat().st_size,
        ledger=Ledger(
            complete=True,
            lossy=False,
            parts=(
                PartLedger(
                    boot_id=part.boot_id,
                    seq_first=0,
                    seq_last=last,
                    recorded=last + 1,
                    lost={},
                    pending=0,
                ),
            ),
            missed_slots=0,
        ),
    )
    write_events(session, folder)
    clock = ClockOffset(
        boot_id=info.boot_id,
        t_mono_ns=int(pieces[0][0].t_mono_ns[0]),
        server_minus_node_ns=OFFSET_NS,
        uncertainty_ns=1000,
    )
    facts = StreamFacts(info.boot_id, info.utc_offset_ns, info.clock_set)
    write_clock(folder / CLOCK_NAME, [clock], [facts])
    sessions.save(session)
    return folder
