"""What writing a recording, and reading a slice of it, takes in each format, turn by turn."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from pathlib import Path

import numpy as np
import recording_data as data
import recording_formats as formats
from recording_data import Extent
from side_by_side import in_turns, note, spread, table

_COLUMN, _SLICE_NS = "pressure_raw_2", 2_000_000_000


def writing(extent: Extent, folder: Path) -> list[str]:
    """CPU and wall time of writing each format."""
    recording = data.emulated(4, extent.seconds)

    def job(name: str, write: formats.Write) -> Callable[[], None]:
        return lambda: write(_fresh(folder / name.replace(" ", "_")), recording)

    jobs = {name: job(name, write) for name, write in formats.writers().items()}
    note("writing")
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


def slices(extent: Extent, folder: Path) -> list[str]:
    """One column of two seconds from the middle."""
    pattern = data.emulated(4, extent.seconds)
    recording = data.lengthened(pattern, extent.sliced_s, data.FULL_RATE_HZ)
    readers = formats.readers()
    writers = formats.writers()
    for name in {found[0] for found in readers.values()}:
        note(f"slices: writing {name}")
        writers[name](folder / name.replace(" ", "_"), recording)
    frames = recording.frames
    begin_ns = int(frames.t_ns[len(frames) // 2])
    inside = (frames.t_ns >= begin_ns) & (frames.t_ns < begin_ns + _SLICE_NS)
    right = frames.pressure_raw[inside, int(_COLUMN[-1])]

    def job(of: str, read: formats.Read) -> Callable[[], object]:
        def run() -> None:
            path = folder / of.replace(" ", "_")
            found = read(path, _COLUMN, begin_ns, begin_ns + _SLICE_NS)
            np.testing.assert_array_equal(found, right)

        return run

    jobs = {name: job(of, read) for name, (of, read) in readers.items()}
    note("slices: reading")
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


def _fresh(path: Path) -> Path:
    """A path beside it with nothing there: a journal is not written over."""
    number = 0
    while (there := path.with_name(f"{path.name}-{number}")).exists():
        number += 1
    return there
