"""Memory and time of sealing, reading and verifying a long session.

    python benchmarks/recording_memory.py [--hours 10] [--tiles 8] [--rate 544] [--folder DIR]

A journal of that length is generated and sealed as a server would (static model, calibration
`paper-eq2-shape`), then read through, one column of a slice is read, and all of it is verified.
Each step runs in a process of its own, whose peak resident memory is printed beside that of a
process that has only imported what it needs.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # for tests.builders

BATCH_FRAMES = 14
LEAD_FRAMES = 1000
STREAM_ID = "b" * 32
SESSION_ID = "20200101T000000Z-000000"
UTC_NS = 1_577_836_800_000_000_000


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def array(tiles: int, rate_hz: float) -> Any:
    from tests.builders.arrays import DATA_SHEET_CHIP, make_array, make_tile

    return make_array(
        [make_tile(i, registers=DATA_SHEET_CHIP) for i in range(tiles)],
        stream_id=STREAM_ID,
        schedule="pipelined",
        nominal_rate_hz=rate_hz,
        utc_offset_ns=UTC_NS,
        models=("static",),
    )


def minute(number: int, tiles: int, rate_hz: float) -> Any:
    from devices.flags import FrameFlag
    from tests.builders.frames import make_frames

    rng = np.random.default_rng(number % 7)
    rows = round(60 * rate_hz)
    seq = np.arange(number * rows, (number + 1) * rows, dtype=np.uint64)
    t_mono_ns = (seq.astype(np.float64) * 1e9 / rate_hz).astype(np.int64)
    t_mono_ns += rng.integers(0, 20_000, rows)
    steps = 20 + 20 * np.sin(np.arange(rows) * 2 * np.pi / rate_hz)
    pressure_raw = 400 - steps[:, None] + rng.normal(0, 1.3, (rows, tiles))
    lead = seq < LEAD_FRAMES
    pressure_raw[lead] = 400 + rng.normal(0, 1.3, (int(lead.sum()), tiles))
    return make_frames(
        seq,
        tiles,
        utc_offset_ns=UTC_NS,
        t_mono_ns=t_mono_ns,
        pressure_raw=pressure_raw.round(),
        temperature_raw=rng.integers(478, 480, (rows, tiles)),
        sample_offset_us=210 * np.arange(tiles) + rng.integers(0, 9, (rows, tiles)),
        frame_flags=np.where(lead, FrameFlag.LEAD, 0),
    )


def generate(folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    from storage.journal.journal import Journal

    journal = Journal(folder / "journal" / "bench" / STREAM_ID, array(asked.tiles, asked.rate))
    for number in range(round(asked.hours * 60)):
        frames = minute(number, asked.tiles, asked.rate)
        for begin in range(0, len(frames), BATCH_FRAMES):
            journal.append_new_frames(
                frames.slice_rows(begin, min(begin + BATCH_FRAMES, len(frames)))
            )
        journal.sync()
    journal.close()
    return {"frames": journal.stored.number_count, "bytes": journal.size_bytes}


def seal_it(folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    from service.offline.calibration_lookup import find_calibration
    from service.sessions.inputs import SessionInputs
    from service.sessions.sealing import write_sealed_files
    from storage.journal.journal import Journal
    from storage.parquet_hash import fill_hash_placeholders_and_sync
    from storage.sessions import writer as session_file
    from storage.sessions.folder import Part, Session, SessionsFolder
    from storage.sessions.footer import ContentDigest
    from storage.sessions.ledger import StreamState, compute_ledger

    hash_s = 0.0

    class Timed(ContentDigest):
        def add_table_and_collect_disorder(self, table: Any) -> None:
            nonlocal hash_s
            begin = time.perf_counter()
            super().add_table_and_collect_disorder(table)
            hash_s += time.perf_counter() - begin

    def timed(path: Path) -> None:
        nonlocal hash_s
        begin = time.perf_counter()
        fill_hash_placeholders_and_sync(path)
        hash_s += time.perf_counter() - begin

    vars(session_file).update(ContentDigest=Timed, fill_hash_placeholders_and_sync=timed)
    info = array(asked.tiles, asked.rate)
    journal = Journal(folder / "journal" / "bench" / STREAM_ID, info)
    last = journal.stored.last
    assert last is not None
    session = Session(
        id=SESSION_ID,
        name="long",
        node="bench",
        state="sealing",
        started_t_ns=UTC_NS,
        stopped_t_ns=UTC_NS + round(asked.hours * 3.6e12),
        parts=(Part(stream_id=STREAM_ID, seq_first=0, seq_last=last),),
        scene="benchmark",
    )
    calibration = find_calibration(
        "paper-eq2-shape", list(info.serials), parts_seed=0, on_progress=lambda _: None
    )
    sources = SessionInputs(
        session, info, {STREAM_ID: journal}, calibration, None, (), {"lost": {}}
    )
    ledger = compute_ledger(
        session.parts, {STREAM_ID: StreamState(stored=journal.stored)}, has_all_parts=True
    )
    sessions = SessionsFolder(folder / "sessions")
    sessions.save_session_json(session)
    begin = time.perf_counter()
    sealed = write_sealed_files(sources, sessions.get_path(SESSION_ID), ledger)
    seal_s = time.perf_counter() - begin
    sessions.save_session_json(sealed)
    return {
        "seconds": seal_s,
        "bytes": sealed.bytes,
        "hash_share": hash_s / seal_s,
        "problem": sealed.problem,
    }


def read_it(folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    from storage.sessions.reader import SealedFileReader

    with SealedFileReader(folder / "sessions" / SESSION_ID / "frames.parquet") as reader:
        frames = sum(len(batch) for batch, _ in reader.read_batches("grf_n", "force_n"))
    return {"frames": frames}


def column(folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    import pyarrow.parquet as pq

    with pq.ParquetFile(folder / "sessions" / SESSION_ID / "frames.parquet") as file:
        middle = file.num_row_groups // 2
        rows = len(file.read_row_group(middle, columns=["grf_n"]))
    return {"rows": rows}


def verify_it(folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    from storage.verify.data_folder import find_verdict, verify_path

    report = verify_path(folder / "sessions" / SESSION_ID)
    return {"verdict": find_verdict(report), "problems": report.problems}


def verify_journal(folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    from storage.verify.data_folder import find_verdict, verify_path

    report = verify_path(folder / "journal" / "bench" / STREAM_ID)
    return {"verdict": find_verdict(report), "problems": report.problems}


def imports(folder: Path, asked: argparse.Namespace) -> dict[str, Any]:
    import service.sessions.sealing
    import storage.verify.data_folder

    return {"modules": [service.sessions.sealing.__name__, storage.verify.data_folder.__name__]}


STEPS = {
    f.__name__: f for f in (imports, generate, seal_it, read_it, column, verify_it, verify_journal)
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=10.0)
    parser.add_argument("--tiles", type=int, default=8)
    parser.add_argument("--rate", type=float, default=544.0)
    parser.add_argument("--folder", type=Path, help="where to work; it is not emptied afterwards")
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.step is not None:
        begin = time.perf_counter()
        found = STEPS[asked.step](asked.folder, asked)
        seconds = found.pop("seconds", time.perf_counter() - begin)
        print(json.dumps({"s": round(seconds, 3), "peak_mb": round(peak_mb()), **found}))
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = asked.folder or Path(temporary)
        print(f"{asked.hours:g} h, {asked.tiles} tiles, {asked.rate:g} Hz")
        for step in STEPS:
            same = [f"--hours={asked.hours}", f"--tiles={asked.tiles}", f"--rate={asked.rate}"]
            command = [sys.executable, __file__, f"--step={step}", f"--folder={folder}", *same]
            said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
            print(f"{step:15} {said.strip()}", flush=True)


if __name__ == "__main__":
    main()
