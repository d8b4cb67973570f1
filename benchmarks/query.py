"""What questions to many sessions cost: `python benchmarks/query.py [--sessions N ...]`.

Of N sealed sessions of some seconds of hopping in mud, one that was really sealed and was copied
under other ids, and a long one of rolling: wall and CPU time of each question in this process,
sessions looked for included, and how many bytes it read. A question for one column, one session or
one second that took all of the frames would show there.
"""

from __future__ import annotations

import argparse
import functools
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from recording_data import Recording, emulated, lengthened, of_scene
from recording_formats import write_journal
from recording_sealing import STATIC, sources_of
from side_by_side import in_turns, note, spread, table

from service.estimation.calibration import make_paper_shape_preset
from service.offline.archive.query import find_sessions, run_query
from service.sessions.sealing import write_sealed_files
from storage.journal.journal import Journal
from storage.sessions.folder import FRAMES_NAME, Session, SessionsFolder
from storage.sessions.ledger import StreamState, compute_ledger

LONG = f"20260101T000000Z-{0:06x}"


@dataclass(frozen=True)
class Extent:
    """How much is made: seconds of the session that is copied, and of the long one."""

    hops_s: float = 8.0
    long_s: float = 600.0
    turns: int = 5


def sealed(recording: Recording, folder: SessionsFolder, session_id: str, work: Path) -> Session:
    """A recording as a server seals it."""
    journal_folder = work / session_id
    write_journal(journal_folder, recording)
    journal = Journal.open_existing_and_recover(journal_folder)
    sources = sources_of(journal, make_paper_shape_preset(), STATIC)
    named = {"id": session_id, "name": recording.title}
    sources = type(sources)(
        **{**vars(sources), "session": sources.session.model_copy(update=named)}
    )
    held = {journal.info.stream_id: StreamState(stored=journal.stored)}
    ledger = compute_ledger(sources.session.parts, held, has_all_parts=True)
    folder.save_session_json(sources.session)
    done = write_sealed_files(sources, folder.get_path(session_id), ledger)
    assert done.problem is None, done.problem
    folder.save_session_json(done)
    return done


def fill(data: Path, sessions: int, extent: Extent) -> None:
    """A data folder with so many sessions, the long one among them."""
    folder = SessionsFolder(data / "sessions")
    work = data.with_name(f"{data.name}-journals")
    once = lengthened(emulated(4, min(extent.long_s, 20.0)), extent.long_s)
    sealed(once, folder, LONG, work)
    ids = [f"20260102T000000Z-{number:06x}" for number in range(sessions - 1)]
    first = sealed(of_scene("mud", extent.hops_s), folder, ids[0], work)
    for session_id in ids[1:]:
        shutil.copytree(folder.get_path(first.id), folder.get_path(session_id))
        folder.save_session_json(first.model_copy(update={"id": session_id}))


def questions(second_t_ns: int) -> dict[str, str]:
    """What is asked, by what it shows."""
    of_long = f"frames WHERE session_id = '{LONG}'"
    second = f"{of_long} AND t_ns BETWEEN {second_t_ns} AND {second_t_ns + 10**9}"
    return {
        "peaks of all third hops in mud": "SELECT session_id, peak_grf_n FROM stances "
        "JOIN sessions USING (session_id) WHERE scene = 'mud' AND number = 3",
        "sessions only": "SELECT scene, count(*) FROM sessions GROUP BY scene",
        "a column of all frames": "SELECT max(grf_n) FROM frames",
        "a column of the long session": f"SELECT max(grf_n) FROM {of_long}",
        "all columns of it": f"SELECT * FROM {of_long}",
        "all columns of a second of it": f"SELECT * FROM {second}",
    }


def bytes_read() -> int:
    """By this process, by calls that read, from the disk or from its cache."""
    fields = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(fields["rchar"])


def measured(data: Path, turns: int) -> list[str]:
    """A row for each question."""
    places = [str(data)]
    start = run_query(
        find_sessions(places), f"SELECT min(t_ns) AS t FROM frames WHERE session_id = '{LONG}'"
    )
    asked = questions(int(start["t"][0].as_py()) + 10**9)
    read: dict[str, int] = {}
    rows: dict[str, int] = {}

    def job(name: str) -> None:
        before = bytes_read()
        rows[name] = len(run_query(find_sessions(places), asked[name]))
        read[name] = bytes_read() - before

    times = in_turns({name: functools.partial(job, name) for name in asked}, turns)
    count = len(find_sessions(places).sessions)
    return [
        f"| {count} | {name} | {rows[name]} | {spread(taken.wall_s, 1e3, 0)} "
        f"| {spread(taken.cpu_s, 1e3, 0)} | {read[name] / 1e6:.2f} |"
        for name, taken in times.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, nargs="+", default=[100, 1000])
    parser.add_argument("--turns", type=int, default=Extent.turns)
    parser.add_argument("--hops-s", type=float, default=Extent.hops_s)
    parser.add_argument("--long-s", type=float, default=Extent.long_s)
    a = parser.parse_args()
    print("\n".join(table(("sessions", "question", "rows", "wall ms", "CPU ms", "MB read"), [], 2)))
    for sessions in a.sessions:
        with tempfile.TemporaryDirectory() as folder:
            data = Path(folder) / "data"
            note(f"{sessions} sessions are made")
            fill(data, sessions, Extent(a.hops_s, a.long_s, a.turns))
            note("questions are asked")
            print("\n".join(measured(data, a.turns)))
            frames = [p.stat().st_size for p in data.glob(f"sessions/*/{FRAMES_NAME}")]
            print(
                f"\n{len(frames)} files of frames, {sum(frames) / 1e6:.0f} MB in all, the longest "
                f"{max(frames) / 1e6:.1f} MB\n"
            )


if __name__ == "__main__":
    main()
