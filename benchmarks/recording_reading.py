"""What reading an hour's journal back costs: opened, read, verified; beside Arrow's own reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
from recording_data import FULL_RATE_HZ, Extent, emulated, lengthened
from recording_formats import write_journal
from side_by_side import in_turns, note, spread, table

from storage.journal.journal import Journal
from storage.verify.journal import verify_journal

LEARNT_S = 60.0
"""Of an emulated recording, which is repeated."""


def jobs(folder: Path, frames: int) -> dict[str, Callable[[], object]]:
    """Ways to read the journal in `folder`."""
    opened = Journal.open_existing_and_recover(folder)

    def arrow_alone() -> None:
        count = 0
        for path in sorted(folder.glob("*.arrows")):
            with pa.OSFile(str(path), "rb") as file, pa.ipc.open_stream(file) as stream:
                count += sum(len(batch) for batch in stream)
        assert count == frames

    def read() -> None:
        assert sum(len(batch) for batch in opened.read_frames(0, frames - 1)) == frames

    def verify() -> None:
        report = verify_journal(folder)
        assert not report.problems, report.problems

    return {
        "Arrow alone, its stream": arrow_alone,
        "`Journal.open`": lambda: Journal.open_existing_and_recover(folder),
        "`Journal.read`": read,
        "`foottile verify` of it": verify,
    }


def read_back(extent: Extent, folder: Path) -> list[str]:
    """A journal of `sliced_s`, as a table scaled to an hour."""
    once = emulated(4, min(LEARNT_S, extent.sliced_s))
    recording = lengthened(once, extent.sliced_s, FULL_RATE_HZ)
    stream = folder / recording.info.node / recording.info.stream_id
    write_journal(stream, recording)
    ways = jobs(stream, len(recording.frames))
    note("reading")
    in_turns(ways, 1)
    times = in_turns(ways, extent.turns)
    hour = 3600 * FULL_RATE_HZ / len(recording.frames)
    rows = [
        (name, spread(taken.cpu_s, hour, 2), spread(taken.wall_s, hour, 2))
        for name, taken in times.items()
    ]
    return [
        *table(("an hour of 4 tiles at 544 Hz", "CPU s", "wall s"), rows),
        "",
        f"{len(recording.frames)} frames, {extent.turns} turns after one that is not counted, "
        "from the page cache.",
    ]
