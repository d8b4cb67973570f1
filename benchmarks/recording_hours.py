"""A journal of many hours: what opening it, reading it and sealing from it take of time and memory.

Each step is a process of its own, because a peak of memory cannot be taken back; its resident
memory is compared with what it had once everything was imported.

    python benchmarks/recording_hours.py STEP FOLDER HOURS
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from recording_data import FULL_RATE_HZ, Extent, Recording, at_rate, batches, emulated, repeated
from recording_formats import size_bytes
from side_by_side import table

from storage.journal.journal import Journal
from storage.schema import wire_schema
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from storage.wire import encode_frames

STEPS = {
    "build": "writing it",
    "open": "Journal.open",
    "read": "Journal.read, all of it",
    "seal": "SessionFrames into SealedFileWriter, raw",
}
_CHUNK = 4096
_SAMPLED = 2000
_MIB = 1 << 20


@dataclass(frozen=True)
class Step:
    """What one step took.

    Attributes:
        frames: that it dealt with.
        cpu_s: CPU time.
        wall_s: by the clock on the wall.
        before_mib: resident memory after the imports.
        peak_mib: the most that was resident.
        files_mib: length of what it has written or read.
        append_us: CPU time of `Journal.append` for a batch, at the beginning and at the end.
    """

    frames: int
    cpu_s: float
    wall_s: float
    before_mib: float
    peak_mib: float
    files_mib: float
    append_us: tuple[float, float] | None = None


def hours_of(recording: Recording, folder: Path, hours: float) -> dict[str, Step]:
    """Build such a journal, open it, then read it and, beside that, seal from it."""
    with SealedFileWriter(folder / "pattern.parquet", recording.info, {}) as writer:
        writer.append_frames(recording.frames, {})
    steps = {}
    for together in (("build",), ("open",), ("read", "seal")):
        running = {name: _started(name, folder, hours) for name in together}
        for name, process in running.items():
            answer, _ = process.communicate()
            if process.returncode:
                raise RuntimeError(f"{STEPS[name]}: ended with code {process.returncode}")
            steps[name] = Step(**json.loads(answer))
            print(f"  {steps[name]}", file=sys.stderr, flush=True)
    return steps


def _started(name: str, folder: Path, hours: float) -> subprocess.Popen[str]:
    print(f"  {hours:g} h: {STEPS[name]} ...", file=sys.stderr, flush=True)
    command = [sys.executable, __file__, name, str(folder), str(hours)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def step(name: str, folder: Path, hours: float) -> Step:
    """One step, in this process."""
    if name == "seal":  # only then, so that the others are without what estimates need
        from recording_sealing import seal, sources_of
    before_mib = _status_mib("VmRSS")
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    append_us = None
    journal = folder / "journal"
    match name:
        case "build":
            frames, append_us = _build(folder, hours)
        case "open":
            frames = Journal.open_existing_and_recover(journal).stored.number_count
        case "read":
            opened = Journal.open_existing_and_recover(journal)
            frames = sum(len(batch) for batch in opened.read_frames(0, opened.stored.last or 0))
        case _:
            frames = seal(
                sources_of(Journal.open_existing_and_recover(journal), None),
                folder / "sealed.parquet",
            )
    return Step(
        frames=frames,
        cpu_s=time.process_time() - cpu_s,
        wall_s=time.perf_counter() - wall_s,
        before_mib=before_mib,
        peak_mib=_status_mib("VmHWM"),
        files_mib=size_bytes(folder / "sealed.parquet" if name == "seal" else journal) / _MIB,
        append_us=append_us,
    )


def _build(folder: Path, hours: float) -> tuple[int, tuple[float, float]]:
    with SealedFileReader(folder / "pattern.parquet") as reader:
        pattern = Recording("", reader.info, reader.read_frames())
    pattern = at_rate(pattern, FULL_RATE_HZ)
    schema = wire_schema(pattern.info)
    journal = Journal(folder / "journal", pattern.info)
    n = round(hours * 3600 * FULL_RATE_HZ)
    spent_us: list[float] = []
    ends: list[float] = []
    synced = 0
    for begin in range(0, n, _CHUNK):
        for batch in batches(repeated(pattern.frames, begin, min(begin + _CHUNK, n))):
            payload = encode_frames(batch, schema)
            began_s = time.thread_time()
            journal.append_new_frames(batch, payload)
            spent_us.append((time.thread_time() - began_s) * 1e6)
        if len(spent_us) > _SAMPLED:
            ends = ends or [statistics.median(spent_us[:_SAMPLED])]
            del spent_us[:-_SAMPLED]
        if begin - synced > 30 * FULL_RATE_HZ:  # closes what is full; each batch would take hours
            journal.sync()
            synced = begin
    journal.close()
    last = statistics.median(spent_us)
    return n, (ends[0] if ends else last, last)


def _status_mib(name: str) -> float:
    """Of this process; what `getrusage` gives may be its parent's."""
    lines = Path("/proc/self/status").read_text("utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) / 1024


def hours(extent: Extent, folder: Path) -> list[str]:
    """Time and memory of a long journal."""
    pattern = emulated(8, extent.seconds)
    steps = hours_of(pattern, folder, extent.hours)
    rows = [
        (
            STEPS[name],
            f"{step.cpu_s:.1f}",
            f"{step.wall_s:.1f}",
            f"{step.before_mib:.0f}",
            f"{step.peak_mib:.0f}",
            f"{step.peak_mib - step.before_mib:.0f}",
            f"{step.files_mib:.0f}",
        )
        for name, step in steps.items()
    ]
    head = ("step", "CPU s", "wall s", "resident before MiB", "peak MiB", "more MiB", "files MiB")
    build = steps["build"]
    first_us, last_us = build.append_us or (float("nan"), float("nan"))
    return [
        *table(head, rows),
        "",
        f"{extent.hours:g} h of 8 tiles at 544 Hz: {build.frames} frames, once each. "
        f"`Journal.append` took {first_us:.0f} us of CPU a batch at the beginning and "
        f"{last_us:.0f} us at the end. Reading and sealing ran beside one another.",
    ]


if __name__ == "__main__":
    print(json.dumps(asdict(step(sys.argv[1], Path(sys.argv[2]), float(sys.argv[3])))))
