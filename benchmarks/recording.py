"""What a recording takes: bytes a frame, and the work of keeping, sealing and reading it.

    python benchmarks/recording.py [--quick] [--only SECTION ...] [--out docs/results/recording.md]

Every figure stands beside the bare library, or another format, that does the same job in the same
run. CSV, HDF5 and Arrow files are written by their own libraries; h5py and hdf5plugin are the extra
`bench`. With `--out`, the sections that were run are replaced in that file, the others stay.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import recording_costs as costs
import recording_data as data
import recording_entropy as entropy
import recording_formats as formats
import recording_hours as long_journal
import recording_sealing as sealing
from side_by_side import in_turns, spread, table

from service.offline.benchmark.run import machine

Lines = list[str]
GOAL = 0.01
"""Share of a core that the journal may take beyond a bare write."""
_COLUMN, _SLICE_NS = "padc_2", 2_000_000_000


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    Attributes:
        seconds: length of each recording.
        real_s: of the one on a real clock; 0: none.
        cost_s: recorded seconds over which appending is measured, twice.
        sealed_s: length of the journal that is sealed.
        sliced_s: length of the session from which a slice is read.
        turns: how often each job is timed.
        hours: length of the long journal.
        with_ladder: with all models, which need a calibration from the bench.
        walk: folder of the measured walk.
    """

    seconds: float = 120.0
    real_s: float = 60.0
    cost_s: float = 60.0
    sealed_s: float = 120.0
    sliced_s: float = 3600.0
    turns: int = 5
    hours: float = 0.2
    with_ladder: bool = True
    walk: Path = Path("../shared/data")


QUICK = Extent(
    seconds=3.0, real_s=2.0, cost_s=3.0, sealed_s=3.0, sliced_s=60.0, turns=2, hours=0.01,
    with_ladder=False,
)  # fmt: skip


def sizes(extent: Extent, folder: Path) -> Lines:
    """Bytes a frame in every format, and against the bound."""
    walked = data.walked(extent.walk, extent.seconds)
    recordings = [
        data.emulated(4, extent.seconds),
        data.emulated(8, extent.seconds),
        *([data.on_real_clock(4, extent.real_s)] if extent.real_s else []),
        *([walked] if walked is not None else []),
    ]
    lines = [
        f"- {r.title}: {len(r.frames)} frames at {r.rate_hz:.0f} Hz, {r.seconds:.0f} s"
        for r in recordings
    ]
    if walked is None:
        lines.append(f"- a person's walk: not measured, no {data.WALK} in `{extent.walk}`")
    lines += [f"- {line}" for line in formats.absent()]
    rows: dict[str, list[str]] = {}
    for number, recording in enumerate(recordings):
        _note(f"sizes of {recording.title}")
        place = folder / str(number)
        place.mkdir()
        for name, write in formats.writers().items():
            write(place / name.replace(" ", "_"), recording)
        n = len(recording.frames)
        sealed = place / "sealed_Parquet"
        per_frame = {
            name: formats.size_bytes(place / name.replace(" ", "_")) / n
            for name in formats.writers()
        }
        bound = _bound(recording, sealed)
        limit = sum(least for _, least in bound.values())
        for name, size in per_frame.items():
            against = f"{size:.1f} ({size / per_frame['sealed Parquet']:.2f})"
            rows.setdefault(name, [name]).append(against)
        for name, size in _with_estimates(recording, place / "estimated", extent).items():
            rows.setdefault(name, [name]).append(
                f"{size:.1f} ({size / per_frame['sealed Parquet']:.2f})"
            )
        rows.setdefault("bound", ["bound by entropy"]).append(
            f"{limit:.1f} ({limit / per_frame['sealed Parquet']:.2f})"
        )
        times = sum(bound[name][1] for name in entropy.TIMES)
        rows.setdefault("times", ["of the bound: when it was"]).append(
            f"{100 * times / limit:.0f} %"
        )
        if recording.title in ("4 tiles, virtual time", "4 tiles, real clock"):
            lines += ["", f"Where the bytes are, {recording.title}:", ""]
            lines += table(
                ("quantity", "sealed Parquet B", "bound B"),
                [(f"`{name}`", f"{a:.2f}", f"{b:.2f}") for name, (a, b) in bound.items()],
            )
    head = ("bytes a frame (times sealed Parquet)", *(r.title for r in recordings))
    return [*table(head, list(rows.values())), "", *lines]


def writing(extent: Extent, folder: Path) -> Lines:
    """CPU and wall time of writing each format."""
    recording = data.emulated(4, extent.seconds)

    def job(name: str, write: formats.Write) -> Callable[[], None]:
        return lambda: write(_fresh(folder / name.replace(" ", "_")), recording)

    jobs = {name: job(name, write) for name, write in formats.writers().items()}
    _note("writing")
    in_turns(jobs, 1)
    times = in_turns(jobs, extent.turns)
    scale = 1e9 / len(recording.frames)
    least = statistics.median(times["sealed Parquet"].cpu_s)
    rows = [
        (
            name,
            spread(taken.cpu_s, scale, 0),
            spread(taken.wall_s, scale, 0),
            f"{statistics.median(taken.cpu_s) / least:.2f}",
        )
        for name, taken in times.items()
    ]
    head = ("format", "CPU ns a frame", "wall ns a frame", "CPU, times sealed Parquet")
    return [
        *table(head, rows),
        "",
        f"{recording.title}, {len(recording.frames)} frames, {extent.turns} turns; the journal in "
        "batches of 25 ms, encoding them included.",
    ]


def appending(extent: Extent, folder: Path) -> Lines:
    """What keeping frames costs while they are taken."""
    pattern = data.emulated(8, extent.seconds)
    recording = data.lengthened(pattern, extent.cost_s, data.FULL_RATE_HZ)
    every = costs.encoded(recording)
    rows = []
    met = []
    for paced in (True, False):
        _note(f"appending, {'paced' if paced else 'one after another'}")
        found = costs.append_costs(recording, folder / f"append-{paced}", paced=paced)
        rows += _cost_rows(found, "every 25 ms" if paced else "at once", len(every), recording)
        more = statistics.median(found["Journal.append"].beyond(found["bare write"]))
        met.append(f"{100 * more:.2f} % {'paced' if paced else 'one after another'}")
    _note("the node's journal")
    found = costs.node_costs(recording, folder / "node")
    rows += _cost_rows(found, "every 25 ms, 5 syncs/s", len(every), recording)
    _note("frames in flight")
    flight = costs.in_flight_costs(recording, folder / "flight")
    scale = 1e6 / round(recording.rate_hz)
    head = ("job", "pace", "CPU us a batch", "of it syncing", "wall us a batch", "% of a core",
            "% of a core beyond the bare write")  # fmt: skip
    return [
        *table(head, rows, 2),
        "",
        *table(
            ("each frame", "CPU us", "% of a core"),
            [
                (f"`{name}`", spread(cost.cpu_s, scale, 2), spread(cost.cpu_s, 100, 3))
                for name, cost in flight.items()
            ],
        ),
        "",
        f"8 tiles at {recording.rate_hz:.0f} Hz, {len(every)} batches of "
        f"{statistics.mean(len(p) for _, p in every):.0f} bytes, {extent.cost_s:g} s; "
        "medians over seconds of the recording, and the least and the greatest of them. "
        f"`Journal.append` beyond the bare write: {', '.join(met)}; the goal is {100 * GOAL:g} %.",
    ]


def sealed(extent: Extent, folder: Path) -> Lines:
    """Journal to Parquet, scaled to an hour."""
    recording = data.emulated(4, extent.sealed_s)
    formats.write_journal(folder / "journal", recording)
    jobs = sealing.jobs(recording, folder, with_ladder=extent.with_ladder)
    _note("sealing")
    in_turns(jobs, 1)
    times = in_turns(jobs, extent.turns)
    hour = 3600 * data.FULL_RATE_HZ / len(recording.frames)
    raw = statistics.median(times["raw"].cpu_s)
    rows = [
        (
            name,
            spread(taken.cpu_s, hour),
            spread(taken.wall_s, hour),
            f"{statistics.median(taken.cpu_s) / raw:.2f}",
            f"{3600 / (statistics.median(taken.cpu_s) * hour):.0f}",
        )
        for name, taken in times.items()
    ]
    head = ("an hour of 4 tiles at 544 Hz", "CPU s", "wall s", "CPU, times raw",
            "times faster than real time")  # fmt: skip
    return [
        *table(head, rows),
        "",
        f"Scaled from {len(recording.frames)} frames, {extent.turns} turns after one that is not "
        "counted; the SHA-256 of the file is included."
        + ("" if extent.with_ladder else " The whole ladder: not measured in a quick run."),
    ]


def slices(extent: Extent, folder: Path) -> Lines:
    """One column of two seconds from the middle."""
    pattern = data.emulated(4, extent.seconds)
    recording = data.lengthened(pattern, extent.sliced_s, data.FULL_RATE_HZ)
    readers = formats.readers()
    writers = formats.writers()
    for name in {found[0] for found in readers.values()}:
        _note(f"slices: writing {name}")
        writers[name](folder / name.replace(" ", "_"), recording)
    frames = recording.frames
    begin_ns = int(frames.t_ns[len(frames) // 2])
    inside = (frames.t_ns >= begin_ns) & (frames.t_ns < begin_ns + _SLICE_NS)
    right = frames.padc[inside, int(_COLUMN[-1])]

    def job(of: str, read: formats.Read) -> Callable[[], object]:
        def run() -> None:
            path = folder / of.replace(" ", "_")
            found = read(path, _COLUMN, begin_ns, begin_ns + _SLICE_NS)
            np.testing.assert_array_equal(found, right)

        return run

    jobs = {name: job(of, read) for name, (of, read) in readers.items()}
    _note("slices: reading")
    in_turns(jobs, 1)
    times = in_turns(jobs, 2 * extent.turns)
    least = statistics.median(times["sealed Parquet, its row group"].cpu_s)
    rows = [
        (
            name,
            spread(taken.cpu_s, 1e3, 2),
            spread(taken.wall_s, 1e3, 2),
            f"{statistics.median(taken.cpu_s) / least:.2f}",
            f"{formats.size_bytes(folder / readers[name][0].replace(' ', '_')) / 1e6:.1f}",
        )
        for name, taken in times.items()
    ]
    head = ("read from", "CPU ms", "wall ms", "CPU, times the row group", "file MB")
    return [
        *table(head, rows),
        "",
        f"`{_COLUMN}` of {len(right)} frames, from {len(frames)} frames of 4 tiles "
        f"({recording.seconds / 60:.0f} min); each opens the file anew, which is in the page "
        f"cache; {2 * extent.turns} turns after one that is not counted. All give the same "
        "numbers.",
    ]


def hours(extent: Extent, folder: Path) -> Lines:
    """Time and memory of a long journal."""
    pattern = data.emulated(8, extent.seconds)
    steps = long_journal.hours_of(pattern, folder, extent.hours)
    rows = [
        (
            long_journal.STEPS[name],
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


SECTIONS: dict[str, tuple[str, Callable[[Extent, Path], Lines]]] = {
    "sizes": ("Bytes a frame", sizes),
    "writing": ("Writing a whole recording", writing),
    "appending": ("Keeping frames while they are taken", appending),
    "sealing": ("Sealing an hour", sealed),
    "slices": ("Two seconds of one tile from the middle", slices),
    "hours": ("A journal of many hours", hours),
}


def _bound(recording: data.Recording, sealed_path: Path) -> dict[str, tuple[float, float]]:
    """By quantity: bytes in Parquet, and the lesser of that and what the predictor's code takes."""
    codes = entropy.bytes_per_frame(recording.frames)
    metadata = pq.ParquetFile(sealed_path).metadata
    stored = dict.fromkeys(codes, 0.0)
    for group in range(metadata.num_row_groups):
        for at in range(metadata.num_columns):
            column = metadata.row_group(group).column(at)
            name = re.sub(r"_\d+$", "", column.path_in_schema)
            stored[name] += column.total_compressed_size / len(recording.frames)
    return {name: (stored[name], min(stored[name], codes[name])) for name in codes}


def _with_estimates(recording: data.Recording, folder: Path, extent: Extent) -> dict[str, float]:
    formats.write_journal(folder / "journal", recording)
    jobs = sealing.jobs(recording, folder, with_ladder=extent.with_ladder)
    found = {}
    for name, stem in (("`static`", "static"), ("the whole ladder", "ladder")):
        job = jobs.get(f"with estimates, {name}")
        if job is not None:
            job()
            size = formats.size_bytes(folder / f"{stem}.parquet") / len(recording.frames)
            found[f"sealed Parquet with estimates, {name}"] = size
    return found


def _cost_rows(
    found: dict[str, costs.Cost], pace: str, batches: int, recording: data.Recording
) -> list[tuple[str, ...]]:
    scale = 1e6 * recording.seconds / batches
    bare = found["bare write"]
    return [
        (
            name if name == "bare write" else f"`{name}`" if "." in name else name,
            pace,
            spread(cost.cpu_s, scale, 0),
            spread(cost.sync_cpu_s, scale, 0) if any(cost.sync_cpu_s) else "-",
            spread(cost.wall_s, scale, 0) if "thread" not in name else "-",
            spread(cost.cpu_s, 100, 2),
            "-" if cost is bare else spread(cost.beyond(bare), 100, 2),
        )
        for name, cost in found.items()
    ]


def _fresh(path: Path) -> Path:
    """A path beside it with nothing there: a journal is not written over."""
    number = 0
    while (there := path.with_name(f"{path.name}-{number}")).exists():
        number += 1
    return there


def _note(text: str) -> None:
    print(f"  {text} ...", file=sys.stderr, flush=True)


def _made_by(load_before: float) -> str:
    root = Path(__file__).resolve().parents[1]
    asked = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    answer = subprocess.run(asked, capture_output=True, text=True, check=False)
    commit = answer.stdout.strip() or "unknown"
    command = shlex.join(["python", "benchmarks/recording.py", *sys.argv[1:]])
    return (
        f"`{command}` at commit {commit}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC; load of the "
        f"machine {load_before:.1f} before and {os.getloadavg()[0]:.1f} after."
    )


def _replaced(page: str, name: str, body: Lines) -> str:
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    section = "\n".join([begin, *body, end])
    if begin not in page:
        return f"{page.rstrip()}\n\n{section}\n"
    head, _, rest = page.partition(begin)
    return head + section + rest.partition(end)[2]


def run(names: list[str], extent: Extent) -> dict[str, Lines]:
    """The sections, each in a temporary folder of its own; TMPDIR says on which disk."""
    done = {}
    for name in names:
        title, measure = SECTIONS[name]
        load = os.getloadavg()[0]
        with tempfile.TemporaryDirectory() as folder:
            lines = measure(extent, Path(folder))
        about = f"{machine()}, pyarrow {pa.__version__}. {_made_by(load)}"
        done[name] = [f"## {title}", "", about, "", *lines]
        print("\n".join(done[name]) + "\n", flush=True)
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="little of everything, half a minute")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, help="sections; default: all")
    parser.add_argument("--hours", type=float, help="length of the long journal")
    parser.add_argument("--data", type=Path, help="folder of the measured walk")
    parser.add_argument("--out", type=Path, help="Markdown file whose sections are replaced")
    a = parser.parse_args()
    extent = QUICK if a.quick else Extent()
    given = {"hours": a.hours, "walk": a.data}
    extent = replace(extent, **{name: v for name, v in given.items() if v is not None})
    done = run(a.only or list(SECTIONS), extent)
    if a.out is not None:
        page = a.out.read_text("utf-8") if a.out.exists() else "# What a recording takes\n"
        for name, lines in done.items():
            page = _replaced(page, name, lines)
        a.out.write_text(page, "utf-8")


if __name__ == "__main__":
    main()
