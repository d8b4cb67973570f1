"""Ten seconds of one column of a sealed session of hours: the server, `export`, and pyarrow alone.

    python benchmarks/slices.py [--hours 1,10] [--turns 15] [--folder DIR]

Sessions of four tiles at 544 Hz with estimates are written from noise; nothing is simulated. Ours
are a request to the server's application in this process, and what `foottile export` and `foottile
estimate` do once they are started; the latter runs its models ten seconds longer and writes all
columns. Beside them stands what pyarrow needs for the same numbers, from the row groups that the
footer's statistics name, with the footer read anew and with one that is kept. Jobs take turns, each
at another place of the session; figures are CPU time of all threads, medians, in brackets the least
and the greatest, and the ratio to pyarrow. The command as a whole is measured as a process, at a
session of a minute, which is its start-up, and at the long ones.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any, TypeVar

import httpx
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
from recording_memory import STREAM_ID, UTC_NS, array, minute
from side_by_side import in_turns, note, spread, table

from service.api.access import Logins
from service.api.app import make_app
from service.estimation import OFFLINE_LAG_MS
from service.offline.estimate.preparation import EstimateRequest
from service.offline.estimate.session import EstimateResult, estimate_session
from service.server.server import Server
from storage.formats.export import make_sealed_export
from storage.formats.slice import Slice
from storage.formats.writers.tables import ARROW
from storage.parquet_hash import compute_sha256
from storage.schema import ESTIMATE_COLUMNS, Array
from storage.sessions.folder import FRAMES_NAME, Ledger, Part, PartLedger, Session, SessionsFolder
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter

TILES, RATE_HZ = 4, 544.0
COLUMN, SECONDS = "grf_n", 10.0
_MINUTE_NS = 60_000_000_000
_BEGIN_NS = int(minute(1, TILES, RATE_HZ).t_ns[0])
"""Of the first frame of every session here."""

Values = npt.NDArray[Any]
T = TypeVar("T")


def session_id(number: int) -> str:
    """Of the session at this place of the list."""
    return f"20200101T000000Z-{number:06x}"


def write(
    data: Path, number: int, minutes: int, *, tiles: int = TILES, rate_hz: float = RATE_HZ
) -> Path:
    """Seal a session of so many minutes of noise, as a server has it."""
    sessions = SessionsFolder(data / "sessions")
    name = session_id(number)
    frames, estimates = minute(1, tiles, rate_hz), noise(round(60 * rate_hz), tiles)
    part = Part(stream_id=STREAM_ID, seq_first=0, seq_last=minutes * len(frames) - 1)
    said = {"id": name, "node": "bench", "parts": [part.model_dump()]}
    path = sessions.get_path(name) / FRAMES_NAME
    path.parent.mkdir(parents=True)
    with SealedFileWriter(path, array(tiles, rate_hz), {"session": said}) as writer:
        for at in range(minutes):
            later = {
                "seq": np.arange(at * len(frames), (at + 1) * len(frames), dtype=np.uint64),
                "t_mono_ns": frames.t_mono_ns + at * _MINUTE_NS,
                "t_ns": frames.t_ns + at * _MINUTE_NS,
            }
            writer.append_frames(replace(frames, **later), estimates)
    count = minutes * len(frames)
    of_part = PartLedger(
        stream_id=STREAM_ID, seq_first=0, seq_last=count - 1, recorded=count, lost={}, pending=0
    )
    sessions.save_session_json(
        Session(
            id=name,
            name=f"{minutes} min",
            node="bench",
            state="sealed",
            started_t_ns=UTC_NS,
            stopped_t_ns=UTC_NS + minutes * _MINUTE_NS,
            parts=(part,),
            scene="benchmark",
            ledger=Ledger(complete=True, lossy=False, parts=(of_part,), missed_slots=0),
            frames=count,
            duration_s=minutes * 60.0,
            bytes=path.stat().st_size,
            sha256=compute_sha256(path),
        )
    )
    return path


def noise(rows: int, tiles: int) -> dict[str, Array]:
    """Estimates that mean nothing and take about as many bytes as those that do."""
    rng = np.random.default_rng(0)
    columns: dict[str, Array] = {"part": np.zeros(rows, dtype=np.uint16)}
    for column in ESTIMATE_COLUMNS:
        values = np.round(rng.normal(0.0, 8.0, (rows, tiles) if column.per_tile else rows) * 8) / 8
        is_bits = pa.types.is_integer(column.type)
        columns[column.name] = np.zeros(rows, column.type.to_pandas_dtype()) if is_bits else values
    return columns


def by_pyarrow(path: Path, start_s: float, metadata: pq.FileMetaData | None) -> Values:
    """Two columns of the row groups whose statistics of `t_ns` meet the slice."""
    begin_ns = _BEGIN_NS + round(start_s * 1e9)
    end_ns = begin_ns + round(SECONDS * 1e9)
    found = []
    with pq.ParquetFile(path, metadata=metadata, page_checksum_verification=True) as file:
        at = file.schema_arrow.get_field_index("t_ns")
        for group in range(file.num_row_groups):
            said: Any = file.metadata.row_group(group).column(at).statistics
            if said.min < end_ns and said.max >= begin_ns:
                rows = file.read_row_group(group, columns=["t_ns", COLUMN])
                t_ns = rows.column("t_ns").to_numpy()
                begin, end = np.searchsorted(t_ns, [begin_ns, end_ns])
                found.append(rows.column(COLUMN).to_numpy()[begin:end])
    return np.concatenate(found)


def by_export(path: Path, start_s: float) -> Values:
    """What `foottile export` does."""
    part = Slice(start_s, start_s + SECONDS, (COLUMN,))
    with SealedFileReader(path, only_slices=True) as reader:
        return _column(b"".join(ARROW.encode(make_sealed_export(reader, part))))


def by_estimate(path: Path, start_s: float) -> EstimateResult:
    """What `foottile estimate` does."""
    with tempfile.TemporaryDirectory() as folder:
        request = EstimateRequest(
            calibration="paper-eq2-shape",
            models=("unwrap", "static"),
            lag_ms=OFFLINE_LAG_MS,
            scene=None,
            tare_s=(0.0, 1.0),
            part=Slice(start_s, start_s + SECONDS),
        )
        return estimate_session(
            path, Path(folder) / "out.parquet", request, on_remark=lambda _: None
        )


def _column(content: bytes) -> Values:
    return pa.ipc.open_file(io.BytesIO(content)).read_all().column(COLUMN).to_numpy()


class Rest:
    """Requests to the server's application, without a socket.

    Its loop runs all the time, as a server's: threads that read files live as long as its task.
    """

    def __init__(self, data: Path) -> None:
        self._server = Server(data)
        self._loop, self._end = asyncio.new_event_loop(), asyncio.Event()
        self._thread = Thread(target=self._loop.run_until_complete, args=(self._end.wait(),))
        self._thread.start()
        transport = httpx.ASGITransport(
            make_app(self._server, logins=Logins("a-token-of-this-benchmark"))
        )
        self._http = httpx.AsyncClient(transport=transport, base_url="http://localhost/api/v1")

    def get(self, path: str, **query: str) -> bytes:
        """What the application answers."""
        answer = self._wait(self._http.get(path, params=query))
        answer.raise_for_status()
        return answer.content

    def slice(self, number: int, start_s: float) -> Values:
        """One GET of the slice."""
        content = self.get(
            f"/sessions/{session_id(number)}/data",
            format="arrow",
            columns=COLUMN,
            start_s=str(start_s),
            end_s=str(start_s + SECONDS),
        )
        return _column(content)

    def close(self) -> None:
        """Let go of the data folder."""
        self._wait(self._http.aclose())
        self._wait(self._server.close())
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()
        self._loop.close()

    def _wait(self, what: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(what, self._loop).result()


def places(minutes: int) -> Iterator[float]:
    """Starts all over the session, the same each time."""
    rng = np.random.default_rng(7)
    while True:
        yield round(float(rng.uniform(0.0, minutes * 60.0 - SECONDS)), 3)


def measure(path: Path, number: int, minutes: int, rest: Rest, turns: int) -> list[list[str]]:
    """A row for each way to the same numbers."""
    kept = pq.read_metadata(path)
    where = {name: places(minutes) for name in _JOBS}

    def job(name: str) -> Callable[[], object]:
        ways: dict[str, Callable[[float], object]] = {
            _JOBS[0]: lambda start_s: rest.slice(number, start_s),
            _JOBS[1]: lambda start_s: by_export(path, start_s),
            _JOBS[2]: lambda start_s: by_pyarrow(path, start_s, None),
            _JOBS[3]: lambda start_s: by_pyarrow(path, start_s, kept),
            _JOBS[4]: lambda _: rest.get("/version"),
            _JOBS[5]: lambda start_s: by_estimate(path, start_s),
        }
        return lambda: ways[name](next(where[name]))

    for _ in range(2):
        first, *others = (job(name)() for name in _JOBS[:4])
        for other in others:
            np.testing.assert_array_equal(first, other)
    times = in_turns({name: job(name) for name in _JOBS}, turns)
    theirs = {
        _JOBS[0]: statistics.median(times[_JOBS[3]].cpu_s),
        _JOBS[1]: statistics.median(times[_JOBS[2]].cpu_s),
    }
    return [
        [
            f"{minutes / 60:g} h",
            name,
            spread(taken.cpu_s, 1e3),
            f"{statistics.median(taken.cpu_s) / theirs[name]:.2f}" if name in theirs else "",
        ]
        for name, taken in times.items()
    ]


_JOBS = (
    "REST, footer kept",
    "`export`",
    "pyarrow, footer read",
    "pyarrow, footer kept",
    "REST, of nothing",
    "`estimate`",
)


_RUN = "from service.cli.main import main; main()"


def command_cpu_s(path: Path, minutes: int) -> float:
    """CPU time of `foottile export` as a process."""
    start_s = next(places(minutes))
    before = _children_s()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.arrow"
        words = [sys.executable, "-c", _RUN, "export", str(path), "--format", "arrow"]
        words += ["--out", str(out), "--columns", COLUMN, "--no-markers"]
        words += [f"--start-s={start_s}", f"--end-s={start_s + SECONDS}"]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        if not len(_column(out.read_bytes())):
            raise RuntimeError("nothing was exported")
    return _children_s() - before


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def report(data: Path, lengths_min: list[int], turns: int) -> list[str]:
    """Both tables."""
    paths = {}
    for number, minutes in enumerate([1, *lengths_min]):
        note(f"writing {minutes} min")
        paths[minutes] = write(data, number, minutes)
    rest, rows, facts = Rest(data), [], []
    try:
        for number, (minutes, path) in enumerate(paths.items()):
            if minutes in lengths_min:
                note(f"slices of {minutes} min")
                rows += measure(path, number, minutes, rest, turns)
            metadata = pq.read_metadata(path)
            facts.append(
                f"{minutes} min: {path.stat().st_size / 1e6:.0f} MB, {metadata.num_row_groups} row "
                f"groups, a footer of {metadata.serialized_size / 1e3:.0f} kB"
            )
    finally:
        rest.close()
    note("the command")
    commands: dict[int, list[float]] = {minutes: [] for minutes in paths}
    for _ in range(max(1, turns // 3)):
        for minutes, path in paths.items():
            commands[minutes].append(command_cpu_s(path, minutes))
    least = statistics.median(commands[1])
    whole = [
        [
            f"{minutes} min",
            spread(taken, 1e3, 0),
            f"{(statistics.median(taken) - least) * 1e3:+.0f}",
        ]
        for minutes, taken in commands.items()
    ]
    return [
        *table(("session", "way", "CPU ms", "times pyarrow"), rows, texts=2),
        "",
        *table(("`foottile export` of", "CPU ms of the process", "beyond a minute's"), whole),
        "",
        f"{SECONDS:g} s of `{COLUMN}`, {turns} turns. " + "; ".join(facts) + ".",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", default="1,10", help="lengths, with commas between")
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--folder", type=Path, help="an empty one, which is left as it is")
    asked = parser.parse_args()
    lengths = [max(2, round(float(hours) * 60)) for hours in asked.hours.split(",")]
    with tempfile.TemporaryDirectory() as temporary:
        print("\n".join(report(asked.folder or Path(temporary), lengths, asked.turns)))


if __name__ == "__main__":
    main()
