"""What a plan over many sessions costs: `python benchmarks/archive.py [--only NAME ...]`.

*Processes*: N sealed sessions of two minutes of rolling, estimated again in one process and in two,
by turns; *cluster*: the same on a Dask scheduler with one worker and with two, each a process of
one thread. Sessions a second in all, and once all run, since workers take seconds to start and
archives hours: from the first outcome of each worker to the last. Beside the latter all CPU time
of workers, scheduler and client, which others on the machine change less. *Overhead*: of a job,
beside the bare estimate of the same short session, in the same process. *Memory*: of a client that
hands out 10, 1,000 and 10,000 proofs, greatest resident set, each in a process of its own. *Long*:
the same of a worker that estimates one session of five minutes, of an hour, and of three.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import psutil
from query import sealed
from recording_data import emulated, lengthened, of_scene
from side_by_side import in_turns, note, spread, table

from service.estimation.compilation import compile_models
from service.offline.archive.jobs import Job, JobMapper, limit_arrow_threads, run_job, run_jobs
from service.offline.archive.locations import find_session_locations
from service.offline.archive.tasks import EstimateTask, SessionTask, VerifyTask
from service.offline.estimate.preparation import CHUNK_FRAMES
from service.offline.estimate.session import estimate_session
from service.offline.worker_pool import Unfinished, map_on_cluster
from service.offline.worker_pool import map_in_processes as over_processes
from storage.sessions.folder import FRAMES_NAME, SessionsFolder
from tests.service.offline.archive.clusters import Cluster

ID = "20260101T000000Z-{:06x}"
ESTIMATE = EstimateTask(
    calibration="paper-eq2-shape",
    models=("unwrap", "static", "denoise"),
    lag_ms=100.0,
    scene=None,
    tare_s=None,
)


def copies(first: Path, count: int) -> None:
    """The same session under other names; of which files are links."""
    for number in range(1, count):
        shutil.copytree(first, first.with_name(ID.format(number)), copy_function=os.link)


def made(data: Path, sessions: int, seconds: float) -> Path:
    """A folder with so many sessions of this length."""
    folder = SessionsFolder(data / "sessions")
    recording = emulated(4, seconds) if seconds > 10.0 else of_scene("mud", seconds)
    first = sealed(recording, folder, ID.format(0), data.with_name("journals"))
    copies(folder.get_path(first.id), sessions)
    return data / "sessions"


def jobs(sessions: Path, task: SessionTask, out: str | None) -> Iterator[Job]:
    return (Job(place, task, out) for place in find_session_locations([str(sessions)]))


Rates = tuple[float, float, float]
"""Sessions a second over all the time, and once all run; CPU seconds for each of the latter."""


def cpu_s() -> float:
    """Of this process, its living children, and those that have ended."""
    own = psutil.Process()
    times = [own.cpu_times(), *(child.cpu_times() for child in own.children(recursive=True))]
    return float(sum(t.user + t.system for t in times) + own.cpu_times().children_user)


def rates(sessions: Path, over: JobMapper, workers: int, label: str) -> Rates:
    """Of a plan; all run once every worker has given its first outcome."""
    with tempfile.TemporaryDirectory() as out:
        begin = time.perf_counter()
        at: list[float] = []
        for outcome in run_jobs(jobs(sessions, ESTIMATE, out), over):
            assert outcome.state == "made", outcome.reason
            at.append(time.perf_counter())
            if len(at) == workers:
                before = cpu_s()
        spent = cpu_s() - before
    note(f"{label}: {len(at)} in {at[-1] - begin:.1f} s")
    running = (len(at) - workers) / (at[-1] - at[workers - 1])
    return len(at) / (at[-1] - begin), running, spent / (len(at) - workers)


def side_by_side(
    sessions: Path, ways: Mapping[str, tuple[JobMapper, int]], turns: int
) -> list[tuple[str, ...]]:
    """A row for each way, and of the second how much more it does than the first."""
    found: dict[str, list[Rates]] = {name: [] for name in ways}
    for turn in range(turns):
        for name in list(ways)[:: 1 if turn % 2 == 0 else -1]:
            found[name].append(rates(sessions, *ways[name], name))
    one, two = found.values()
    ratios = [[b[i] / a[i] for a, b in zip(one, two, strict=True)] for i in (0, 1)]
    return [
        (
            name,
            *(spread([each[i] for each in values], digits=2) for i in range(3)),
            "" if values is one else spread(ratios[0], digits=2),
            "" if values is one else spread(ratios[1], digits=2),
        )
        for name, values in found.items()
    ]


HEAD = (
    "way",
    "sessions/s in all",
    "once running",
    "CPU s a session",
    "ratio in all",
    "ratio once running",
)


def processes(a: argparse.Namespace, work: Path) -> list[str]:
    sessions = made(work / "data", a.sessions, a.seconds)
    ways: dict[str, tuple[JobMapper, int]] = {
        f"{n} processes": (
            partial(over_processes, process_count=n, initializer=limit_arrow_threads),
            n,
        )
        for n in (1, 2)
    }
    return table(HEAD, side_by_side(sessions, ways, a.turns))


def cluster(a: argparse.Namespace, work: Path) -> list[str]:
    sessions = made(work / "data", a.sessions, a.seconds)
    folders = [work / "one", work / "two"]
    for folder in folders:
        folder.mkdir()
    with Cluster(folders[0], 1) as one, Cluster(folders[1], 2) as two:
        ways: dict[str, tuple[JobMapper, int]] = {
            "1 Dask worker": (partial(map_on_cluster, scheduler_address=one.address), 1),
            "2 Dask workers": (partial(map_on_cluster, scheduler_address=two.address), 2),
        }
        for name, (over, workers) in ways.items():  # what is compiled is loaded
            rates(sessions, over, workers, f"{name}, first")
        return table(HEAD, side_by_side(sessions, ways, a.turns))


def overhead(a: argparse.Namespace, work: Path) -> list[str]:
    sessions = made(work / "data", a.short, 2.0)
    places = list(find_session_locations([str(sessions)]))

    def bare(folder: Path) -> None:
        for place in places:
            out = folder / place.session_id
            out.mkdir()
            file = Path(place.frames_uri)
            estimate_session(
                file, out / FRAMES_NAME, ESTIMATE, on_remark=lambda _: None, with_findings=False
            )

    def as_jobs(folder: Path) -> None:
        for place in places:
            assert not isinstance(made := run_job(Job(place, ESTIMATE, str(folder))), Unfinished)
            assert made.state == "made"

    def in_folder(way: Callable[[Path], None]) -> None:
        with tempfile.TemporaryDirectory(dir=work) as folder:
            way(Path(folder))

    ways = {name: partial(in_folder, way) for name, way in (("bare", bare), ("jobs", as_jobs))}
    in_turns(ways, 1)
    times = in_turns(ways, a.turns)
    each = 1e3 / len(places)
    rows = [(n, spread(t.wall_s, each), spread(t.cpu_s, each)) for n, t in times.items()]
    more = [
        spread([j - b for j, b in zip(jobs_s, bare_s, strict=True)], each)
        for jobs_s, bare_s in (
            (times["jobs"].wall_s, times["bare"].wall_s),
            (times["jobs"].cpu_s, times["bare"].cpu_s),
        )
    ]
    return table(("of a session", "wall ms", "CPU ms"), [*rows, ("overhead", *more)])


def memory(a: argparse.Namespace, work: Path) -> list[str]:
    sessions = made(work / "data", a.archives[0], 2.0)
    rows = []
    for count in a.archives:
        have = sum(1 for _ in sessions.iterdir())
        for number in range(have, count):
            copy = sessions / ID.format(number)
            shutil.copytree(sessions / ID.format(0), copy, copy_function=os.link)
        note(f"{count} proofs")
        begin = time.perf_counter()
        told = subprocess.run(
            [sys.executable, __file__, "--client", sessions], check=True, capture_output=True
        )
        rows.append((str(count), told.stdout.decode(), f"{time.perf_counter() - begin:.1f}"))
    return table(("sessions", "greatest resident set of the client, MB", "s in all"), rows, 0)


def client(sessions: Path) -> None:
    """Body of the process whose memory is measured: two workers, and no results kept."""
    over = partial(over_processes, process_count=2, initializer=limit_arrow_threads)
    for outcome in run_jobs(jobs(sessions, VerifyTask(), None), over):
        assert outcome.state == "made", outcome.reason
    tell_greatest()


def tell_greatest() -> None:
    """Print the greatest resident set of this process."""
    status = Path("/proc/self/status").read_text()  # getrusage has what was before exec in it
    (greatest_kb,) = re.findall(r"VmHWM:\s+([0-9]+)", status)
    print(f"{int(greatest_kb) / 1024:.1f}", end="")


def long(a: argparse.Namespace, work: Path) -> list[str]:
    rows = []
    for minutes in a.minutes:
        data = work / f"{minutes:g}"
        folder, session_id = SessionsFolder(data / "sessions"), ID.format(0)
        once = lengthened(emulated(4, 20.0), 60.0 * minutes)
        sealed(once, folder, session_id, data / "journals")
        for way, piece_frames in (("one", sys.maxsize), ("of a million frames", CHUNK_FRAMES)):
            note(f"{minutes:g} minutes, pieces: {way}")
            command = (
                "--estimate",
                folder.get_path(session_id),
                "--piece-frames",
                str(piece_frames),
            )
            told = subprocess.run(
                [sys.executable, __file__, *command], check=True, capture_output=True, text=True
            )
            rows.append((f"{minutes:g}", way, *told.stdout.split()))
    return table(("minutes", "pieces", "greatest resident set, MB", "CPU s", "wall s"), rows, 0)


def estimate(session: Path, piece_frames: int) -> None:
    """Body of the process whose memory is measured, once what is compiled is loaded."""
    compile_models()
    limit_arrow_threads()
    begin, before = time.perf_counter(), cpu_s()
    with tempfile.TemporaryDirectory() as out:
        (job,) = jobs(session, replace(ESTIMATE, piece_frames=piece_frames), out)
        while isinstance(outcome := run_job(job), Unfinished):
            pass
    assert outcome.state == "made", outcome.reason
    spent, took = cpu_s() - before, time.perf_counter() - begin
    tell_greatest()
    print(f" {spent:.1f} {took:.1f}", end="")


PARTS = {
    "processes": processes,
    "cluster": cluster,
    "overhead": overhead,
    "memory": memory,
    "long": long,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--sessions", type=int, default=40)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--short", type=int, default=40, help="Sessions for the overhead.")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--archives", type=int, nargs="+", default=[10, 1_000, 10_000])
    parser.add_argument("--minutes", type=float, nargs="+", default=[5.0, 60.0, 180.0])
    parser.add_argument("--estimate", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--piece-frames", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--client", type=Path, help=argparse.SUPPRESS)
    a = parser.parse_args()
    if a.client is not None:
        client(a.client)
        return
    if a.estimate is not None:
        estimate(a.estimate, a.piece_frames)
        return
    for name in a.only:
        with tempfile.TemporaryDirectory() as work:
            note(name)
            load = re.split(" ", Path("/proc/loadavg").read_text())[0]
            rows = PARTS[name](a, Path(work))
            print(f"\n### {name} (load {load} before)\n", *rows, sep="\n", flush=True)


if __name__ == "__main__":
    main()
