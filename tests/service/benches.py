"""A bench recording as a server has one: frames without notes of the mill, its steps as markers."""

from __future__ import annotations

import uuid
from pathlib import Path

import numpy as np

from devices.scene.scene_file import validate_scene
from service.offline.calibration_lookup import make_rig_scene
from service.offline.simulation import SimulationOptions, run_simulation
from service.rig.emulated_foot import EmulatedFoot
from service.version import SOFTWARE_VERSION
from storage.clock.log import ClockOffset
from storage.clock.table import CLOCK_NAME, StreamClockFacts, write_clock_file
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import (
    FRAMES_NAME,
    Ledger,
    Marker,
    Part,
    PartLedger,
    Session,
    SessionsFolder,
)
from storage.sessions.metadata import write_markers
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter

SESSION_ID = "20260101T000000Z-be5c00"
OFFSET_NS = 3_000_000_000
"""The server's clock less the node's."""


def pressed(cache: Path) -> Path:
    """Tile T01, pressed twice and slowly, then held, with the mill's notes; made once."""
    kept = cache / f"{SOFTWARE_VERSION}-strokes-T01.parquet"
    if not kept.exists():
        scene = make_rig_scene("T01").model_dump()
        scene["ground"] |= {"repeats": 2, "stroke_s": 1.5}
        made = cache / f"{uuid.uuid4().hex}.parquet"
        short = validate_scene(scene, where="a short bench")
        run_simulation(SimulationOptions(short, foot=EmulatedFoot(), seconds=9.0), made, None)
        made.rename(kept)
    return kept


def steps_of(pressed_tile: np.ndarray, phase: np.ndarray, t_ns: np.ndarray) -> list[Marker]:
    """A marker wherever what is done becomes something else, as a controller would make it."""
    said = [
        ("soak" if what == "soak" else "end") if tile is None else f"{tile} {what}"
        for tile, what in zip(pressed_tile, phase, strict=True)
    ]
    begins = [i for i, text in enumerate(said) if i == 0 or said[i - 1] != text]
    return [Marker(id=f"{i:012x}", label=said[i], t_ns=int(t_ns[i]) + OFFSET_NS) for i in begins]


def put(recording: Path, data: Path, *, marked: bool = True) -> Path:
    """Put it into a server's data folder as a sealed session; its folder."""
    sessions = SessionsFolder(data / "sessions")
    folder = sessions.get_path(SESSION_ID)
    folder.mkdir(parents=True)
    with SealedFileReader(recording) as reader:
        pieces = list(reader.read_batches("pressed_tile", "phase"))
        info = reader.info
        last = reader.frame_count - 1
        part = Part(stream_id=info.stream_id, seq_first=0, seq_last=last)
        about = {"id": SESSION_ID, "parts": [part.model_dump()]}
        with SealedFileWriter(folder / FRAMES_NAME, info, {"session": about}) as writer:
            for frames, _ in pieces:
                writer.append_frames(frames, {})
    steps = steps_of(
        np.concatenate([extra["pressed_tile"] for _, extra in pieces]),
        np.concatenate([extra["phase"] for _, extra in pieces]),
        np.concatenate([frames.t_ns for frames, _ in pieces]),
    )
    remark = Marker(id="f" * 12, label="the window is open", t_ns=steps[0].t_ns)
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
        markers=(remark, *(reversed(steps) if marked else ())),
        frames=last + 1,
        sha256=compute_sha256(frames_path),
        bytes=frames_path.stat().st_size,
        ledger=Ledger(
            complete=True,
            lossy=False,
            parts=(
                PartLedger(
                    stream_id=part.stream_id,
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
    write_markers(session, folder)
    clock = ClockOffset(
        stream_id=info.stream_id,
        t_mono_ns=int(pieces[0][0].t_mono_ns[0]),
        server_minus_node_ns=OFFSET_NS,
        uncertainty_ns=1000,
    )
    facts = StreamClockFacts(info.stream_id, info.utc_offset_ns, info.clock_set)
    write_clock_file(folder / CLOCK_NAME, [clock], [facts])
    sessions.save_session_json(session)
    return folder
