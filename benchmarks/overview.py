"""What a plot of a session costs: the first picture, a zoom, and the server's memory.

    python benchmarks/overview.py [--hours 1,10] [--tiles 8] [--zooms 200]

Sealed sessions of noise are asked of a server in a process of its own for 1000 bins at least, all
columns, as JSON and as Arrow. The first picture is the whole session, right after the server's
start, and again. Zooms are of random places and widths, evenly in the logarithm from a tenth of a
second to the whole. Wall clock at the client over loopback, and the server's CPU; beside it what
pyarrow takes to read the GRF of the same seconds from the file and to find the extremes of a
thousand bins of it. The pyramid itself is timed as sealing makes it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from served import Server, served
from slices import session_id, write

from service.sessions.overview import OverviewWriter
from storage.sessions.overview import OVERVIEW_NAME
from storage.sessions.reader import SealedFileReader

RATE_HZ = 544.0
POINTS = 1000
ARROW = {"Accept": "application/vnd.apache.arrow.stream"}


def asked(server: Server, name: str, part: dict[str, float], **headers: str) -> tuple[float, int]:
    """Seconds until a picture is there, and its bytes."""
    query = {"points": POINTS, **part}
    began_s = time.perf_counter()
    answer = server.http.get(f"/sessions/{name}/timeseries", params=query, headers=headers)
    answer.raise_for_status()
    return time.perf_counter() - began_s, len(answer.content)


def zoom(random: Random, length_s: float) -> dict[str, float]:
    """Some seconds, anywhere."""
    width_s = 0.1 * (length_s / 0.1) ** random.random()
    start_s = random.uniform(0.0, length_s - width_s)
    return {"start_s": start_s, "end_s": start_s + width_s}


def by_pyarrow(path: Path, part: dict[str, float]) -> float:
    """Seconds to read one column of the same row groups, and to find extremes."""
    began_s = time.perf_counter()
    with pq.ParquetFile(path) as file:
        at = file.schema_arrow.get_field_index("t_ns")
        said: list[Any] = [
            file.metadata.row_group(g).column(at).statistics for g in range(file.num_row_groups)
        ]
        zero_ns = said[0].min
        begin_ns, end_ns = (zero_ns + round(1e9 * part[name]) for name in ("start_s", "end_s"))
        groups = [g for g, s in enumerate(said) if s.min < end_ns and s.max >= begin_ns]
        values = file.read_row_groups(groups, columns=["grf_n"]).column("grf_n").to_numpy()
    starts = np.arange(0, len(values), max(1, len(values) // POINTS))
    np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    return time.perf_counter() - began_s


def gathered(path: Path) -> float:
    """CPU seconds that sealing takes for the pyramid."""
    spent_s = 0.0
    with SealedFileReader(path, only_slices=True) as reader:
        beside = OverviewWriter(len(reader.info.tiles))
        names = ("grf_n", "grf_sigma_n", "grf_lower_bound_n", "cop_x_m", "cop_y_m", "angle_rad")
        for frames, columns in reader.read_batches(*names, "contact", "estimate_flags", "force_n"):
            began_s = time.process_time()
            beside.try_add_frames(frames, columns)
            spent_s += time.process_time() - began_s
        began_s = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            beside.try_write_file(Path(folder), "0" * 64)
        return spent_s + time.process_time() - began_s


def lines(hours: list[float], tiles: int, zooms: int) -> Iterator[str]:
    """The table, line by line."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder)
        paths = [
            write(data, number, round(60 * length), tiles=tiles, rate_hz=RATE_HZ)
            for number, length in enumerate(hours)
        ]
        yield "| session | what | wall ms | server's CPU ms | kB |"
        yield "|---|---|--:|--:|--:|"
        for number, (length, path) in enumerate(zip(hours, paths, strict=True)):
            yield from of_session(data, session_id(number), length * 3600.0, path, zooms)


def of_session(data: Path, name: str, length_s: float, path: Path, zooms: int) -> Iterator[str]:
    """Of one session, by a server that has just begun."""
    of = f"{length_s / 3600.0:g} h"
    with served(data) as server:
        asked(server, name, {"start_s": 0.0, "end_s": 1.0})  # made from the frames
    beside = path.with_name(OVERVIEW_NAME)
    size_mb = beside.stat().st_size * 1e-6
    share = size_mb / path.stat().st_size * 1e8
    yield f"| {of} | overview.arrow: {size_mb:.1f} MB, {share:.1f} % of the frames | | | |"
    yield f"| {of} | pyramid at sealing | | {1e3 * gathered(path):.0f} | |"
    with served(data) as server:
        before_mb = server.rss_mb
        for what in ("first picture", "again"):
            yield _row(of, f"{what}, JSON", *_cost(server, name, [{}], {}))
        yield _row(of, "again, Arrow", *_cost(server, name, [{}], ARROW))
        random = Random(1)  # noqa: S311  # no secret
        parts = [zoom(random, length_s) for _ in range(zooms)]
        for kind, headers in (("JSON", {}), ("Arrow", ARROW)):
            yield _row(of, f"a zoom of {zooms}, {kind}", *_cost(server, name, parts, headers))
        theirs = [1e3 * by_pyarrow(path, part) for part in parts]
        yield f"| {of} | the GRF alone by pyarrow | {_spread(theirs)} | | |"
        yield f"| {of} | the server has grown by {server.rss_mb - before_mb:.1f} MB | | | |"


def _cost(
    server: Server, name: str, parts: list[dict[str, float]], headers: dict[str, str]
) -> tuple[list[float], float, float]:
    before_s = server.cpu_s
    found = [asked(server, name, part, **headers) for part in parts]
    spent_ms = 1e3 * (server.cpu_s - before_s) / len(parts)
    return [1e3 * wall for wall, _ in found], spent_ms, max(size for _, size in found) * 1e-3


def _row(of: str, what: str, wall_ms: list[float], cpu_ms: float, size_kb: float) -> str:
    return f"| {of} | {what} | {_spread(wall_ms)} | {cpu_ms:.0f} | {size_kb:.0f} |"


def _spread(values: list[float]) -> str:
    if len(values) == 1:
        return f"{values[0]:.0f}"
    return f"{np.median(values):.0f} (p95 {np.percentile(values, 95):.0f}, most {max(values):.0f})"


def main() -> None:
    """See the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", default="1,10")
    parser.add_argument("--tiles", type=int, default=8)
    parser.add_argument("--zooms", type=int, default=200)
    asked_for = parser.parse_args()
    hours = [float(part) for part in asked_for.hours.split(",")]
    for line in lines(hours, asked_for.tiles, asked_for.zooms):
        print(line, flush=True)


if __name__ == "__main__":
    main()
