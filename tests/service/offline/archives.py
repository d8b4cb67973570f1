"""Folders of sealed sessions, of a foot that stands and hops, and tasks that are run on them."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from service.offline.archive.jobs import Job, Outcome, run_jobs
from service.offline.archive.locations import find_session_locations
from service.offline.archive.tasks import EstimateTask, SessionTask
from service.offline.worker_pool import map_in_processes
from service.sessions.inputs import SessionInputs
from service.sessions.sealing import write_sealed_files
from storage.journal.journal import Journal
from storage.sessions.folder import Marker, Part, Session, SessionsFolder
from storage.sessions.ledger import StreamState, compute_ledger
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import PERIOD_NS, UTC_NS
from tests.service.sessions.pieces import array, calibration, frames, hopping

IDS = tuple(f"20260101T00000{number}Z-00000{number}" for number in range(6))
STATIC = EstimateTask(calibration=None, models=("static",), lag_ms=100.0, scene=None, tare_s=None)
HOP = 50
"""Frames of a hop, and between two."""


def hops_n(*peaks_n: float) -> np.ndarray:
    """Hops with these peaks, half on each of two noisy tiles, after a lead of 200 frames."""
    still = np.zeros(HOP)
    half_sine = np.sin(np.pi * np.arange(HOP) / HOP)
    loads = [np.zeros(200), *(part for peak in peaks_n for part in (half_sine * peak, still))]
    force_n = np.concatenate(loads)[:, None] / 2
    return np.asarray(force_n + np.random.default_rng(1).normal(0.0, 1.0, (len(force_n), 2)))


def session_of(number: int, scene: str, state: str = "sealing", **facts: object) -> Session:
    return Session.model_validate(
        {
            "id": IDS[number],
            "name": f"trial {number}",
            "node": "bench",
            "state": state,
            "started_t_ns": UTC_NS,
            "stopped_t_ns": UTC_NS + 10**9,
            "parts": (Part(stream_id=str(number) * 32, seq_first=0, seq_last=None),),
            "scene": scene,
            **facts,
        }
    )


def sealed(
    data: Path, number: int, *peaks_n: float, scene: str = "mud", is_calibrated: bool = True
) -> Path:
    """A sealed session of such hops, with a marker at its beginning."""
    loads_n = hops_n(*peaks_n)
    batch = frames(loads_n, lead=200)
    info = array(1e9 / PERIOD_NS).model_copy(
        update={"stream_id": str(number) * 32, "models": ("static",), "scene": scene}
    )
    journal = Journal(data / "journal" / "bench" / info.stream_id, info)
    journal.append_new_frames(batch)
    journal.close()
    part = Part(stream_id=info.stream_id, seq_first=0, seq_last=len(batch) - 1)
    event = Marker(id=f"e{number}", label="=off", t_ns=UTC_NS)
    begun = session_of(number, scene, parts=(part,), markers=(event,))
    folder = SessionsFolder(data / "sessions")
    folder.save_session_json(begun)
    sources = SessionInputs(
        session=begun,
        info=info,
        journals={info.stream_id: journal},
        calibration=calibration(*info.serials) if is_calibrated else None,
        problem=None if is_calibrated else "the node had no calibration",
        tares=(),
        notes={"lost": {}},
    )
    held = {info.stream_id: StreamState(stored=journal.stored)}
    done = write_sealed_files(
        sources, folder.get_path(begun.id), compute_ledger(begun.parts, held, has_all_parts=True)
    )
    folder.save_session_json(done)
    return folder.get_path(begun.id)


def recording(data: Path, number: int) -> Path:
    """A session that is being recorded."""
    folder = SessionsFolder(data / "sessions")
    folder.save_session_json(session_of(number, "mud", "recording"))
    return folder.get_path(IDS[number])


def long_session(path: Path) -> Path:
    """A file of three row groups, a minute each, with a lead."""
    batch = frames(hopping(9000, loaded_from=200), lead=200, period_ns=20_000_000)
    with SealedFileWriter(path, array(50.0), {}) as writer:
        writer.append_frames(batch, {})
    return path


def ran(task: SessionTask, place: Path | str, out: Path | str | None) -> dict[str, Outcome]:
    """What comes of a task, in this process, by the sessions' names."""
    where = None if out is None else str(out)
    jobs = [Job(found, task, where) for found in find_session_locations([str(place)])]
    return {each.name: each for each in run_jobs(jobs, partial(map_in_processes, process_count=1))}


def made(found: dict[str, Outcome]) -> set[str]:
    """Names of the sessions whose results were made."""
    return {name for name, outcome in found.items() if outcome.state == "made"}


def contents(out: Path) -> dict[str, bytes]:
    """All files of results."""
    return {str(p.relative_to(out)): p.read_bytes() for p in out.glob("*/*") if p.is_file()}


def with_a_damaged_page(path: Path) -> bytes:
    """A sealed file's bytes with a bit flipped in the data of `grf_n`."""
    at = pq.read_schema(path).get_field_index("grf_n")
    chunk = pq.ParquetFile(path).metadata.row_group(0).column(at)
    content = bytearray(path.read_bytes())
    content[chunk.data_page_offset + chunk.total_compressed_size - 5] ^= 1
    return bytes(content)
