"""A walk that nobody went: frames with estimates of which every number is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from devices.frames import ArrayInfo
from storage.clock.bounds import OffsetRows
from storage.clock.table import ClockTable, StreamClockFacts
from storage.formats.export import Export, FrameSource, make_one_pass_frame_source
from storage.formats.slice import Slice
from storage.schema import Array
from tests.builders.arrays import UTC_NS, make_array, make_tile
from tests.builders.frames import make_frames, with_columns

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "formats.md"
RATE_HZ = 500.0
ROWS = 1000
STANCES = ((100, 400), (500, 900))
"""First frame of each, and the one behind its last."""
PEAK_N = 30.0
ARRAY = make_array(
    [
        make_tile(0, x_m=0.03, y_m=0.01),
        make_tile(1, x_m=0.03, y_m=-0.01),
        make_tile(2, x_m=-0.01, y_m=0.01),
        make_tile(3, x_m=-0.01, y_m=-0.01),
        make_tile(4, x_m=0.3, y_m=0.0, reference=True),
    ]
)


def walk() -> dict[str, Array]:
    """Columns of two stances: in the first the foot rolls forward, in the second it stands.

    Noise without contact is 0.05 N; the first and the last frame of a stance have no COP.
    """
    n = np.arange(ROWS)
    columns = {
        "grf_n": np.where(n % 2, 0.05, -0.05),
        "grf_sigma_n": np.full(ROWS, 0.25),
        "grf_lower_bound_n": np.zeros(ROWS),
        "cop_x_m": np.full(ROWS, np.nan),
        "cop_y_m": np.full(ROWS, np.nan),
        "contact": np.zeros(ROWS, dtype=np.uint8),
        "estimate_flags": np.full(ROWS, 16, dtype=np.uint16),
        "part": np.zeros(ROWS, dtype=np.uint16),
    }
    for number, (begin, end) in enumerate(STANCES):
        phase = (np.arange(begin, end) - begin + 1) / (end - begin + 1)
        columns["contact"][begin:end] = 1
        columns["grf_n"][begin:end] = PEAK_N * np.sin(np.pi * phase)
        columns["grf_lower_bound_n"][begin:end] = columns["grf_n"][begin:end] - 0.6
        rows = slice(begin + 1, end - 1)
        columns["cop_x_m"][rows] = -0.01 + 0.04 * phase[1:-1] if number == 0 else 0.02
        columns["cop_y_m"][rows] = 0.004
        columns["estimate_flags"][rows] = 0
    force_n = np.repeat(0.25 * columns["grf_n"][:, None], len(ARRAY.tiles), axis=1)
    force_n[:, -1] = np.nan
    return {**columns, "force_n": force_n}


ROW = make_array([*ARRAY.tiles[::2]])
"""Two tiles in one row at y = 10 mm, and a bare one."""


def row_walk() -> dict[str, Array]:
    """The same walk on `ROW`, whose tiles do not measure y."""
    columns = walk()
    columns["force_n"] = columns["force_n"][:, ::2]
    return {**columns, "cop_y_m": np.full(ROWS, np.nan)}


def saturated(columns: dict[str, Array], rows: slice) -> dict[str, Array]:
    """The same with a tile beyond its range there."""
    changed = {name: values.copy() for name, values in columns.items()}
    for name in ("grf_n", "cop_x_m", "cop_y_m"):
        changed[name][rows] = np.nan
    changed["estimate_flags"][rows] |= 1 | 16
    return changed


def lines_of_documents(section: str) -> str:
    """The example in Python of a section of docs/formats.md."""
    text = DOCUMENT.read_text("utf-8").split(f"\n## {section}\n")[1].split("\n## ")[0]
    return text.split("```python\n")[1].split("```")[0]


def export_of_walk(
    columns: dict[str, Array] | None = None,
    *,
    keep: Array | None = None,
    info: ArrayInfo = ARRAY,
    notes: dict[str, object] | None = None,
    every: int = 300,
    times: dict[str, Any] | None = None,
    **facts: Any,
) -> Export:
    """An export of a walk.

    Args:
        columns: its estimates; None: of `walk`.
        keep: the frames that are there; None: all.
        info: the array.
        notes: of the session.
        every: rows of a piece.
        times: further columns of `make_frames`.
        facts: further attributes of `Export`.
    """
    columns = walk() if columns is None else columns
    count = len(next(iter(columns.values())))
    kept = np.arange(count) if keep is None else keep
    given = {name: np.asarray(values)[kept] for name, values in (times or {}).items()}
    frames = with_columns(make_frames(kept, len(info.tiles)), **given)

    def content() -> FrameSource:
        return make_one_pass_frame_source(
            (
                frames.slice_rows(a, a + every),
                {name: v[kept][a : a + every] for name, v in columns.items()},
            )
            for a in range(0, len(kept), every)
        )

    # As often as a format likes, as a sealed file gives them.
    again = replace(content(), read_columns=lambda names: content().read_columns(names))
    made = Export(again, info, notes or {}, facts.pop("part", Slice()))
    return replace(made, **facts)


LATE_NS = 300_000_000
BOUND_NS = 400_000


def compared(later_ns: int) -> ClockTable:
    """A clock that is behind the server's by so much."""
    stream_id = ARRAY.stream_id
    rows = OffsetRows(*np.array([[0], [later_ns], [BOUND_NS]], dtype=np.int64))
    return ClockTable({stream_id: rows}, [StreamClockFacts(stream_id, UTC_NS, True)], [stream_id])


def two_feet(*nodes: str, **facts: Any) -> list[Export]:
    """The same walk on two nodes, of which the clock of the second is behind the first's."""
    first, second = nodes or ("left", "right-2")
    return [
        export_of_walk(
            info=ARRAY.model_copy(update={"node": node}), clock=compared(later_ns), **facts
        )
        for node, later_ns in ((first, 0), (second, LATE_NS))
    ]
