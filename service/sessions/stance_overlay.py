"""Overlay of a sealed session's stances, from its file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from devices.errors import UnknownError
from service.estimation.stance_overlay import (
    OVERLAY_COLUMNS,
    Overlay,
    StanceOverlayBuilder,
    select_evenly,
)
from storage.sessions.reader import SealedFileReader

STANCES_MAX = 4000
"""Limit of overlaid stances, evenly spread over the session: two seconds of work."""


@dataclass(frozen=True)
class SessionOverlay:
    """Overlay of the whole stances of a session.

    Attributes:
        overlay: curves, mean and spread.
        numbers: numbers of the stances with single curves, in the order of its rows.
        whole_count: number of stances that could be overlaid.
        overlaid_count: number of stances in mean and spread: all, or `STANCES_MAX`.
        partial_count: number of stances left out as incomplete.
        too_short_count: number of stances left out as single frames without duration.
    """

    overlay: Overlay
    numbers: tuple[int, ...]
    whole_count: int
    """number of stances that could be overlaid."""
    overlaid_count: int
    """number of stances in mean and spread: all, or `STANCES_MAX`."""
    partial_count: int
    """number of stances left out as incomplete."""
    too_short_count: int
    """number of stances left out as single frames without duration."""


def overlay_stances(
    session: SealedFileReader, stances: pa.Table, *, points: int, curves: int
) -> SessionOverlay:
    """Overlay the stances of a sealed session.

    Args:
        session: frames of the session, open for slices.
        stances: table of `service.sessions.stances.load_stances`.
        points: number of percentages of the duration, from 0 to 100.
        curves: limit of single curves, evenly spread over the session.

    Raises:
        UnknownError: it lacks estimates of an overlaid quantity.
        FileFormatError: it is damaged.
    """
    if absent := [name for name in OVERLAY_COLUMNS if not session.has_columns(name)]:
        raise UnknownError(
            f"stances cannot be overlaid without {', '.join(absent)}",
            where=str(session.path),
            remedy="`foottile estimate` makes them",
        )
    whole = stances.filter(stances["is_whole"])
    long = whole.filter(pc.greater(whole["end_t_ns"], whole["begin_t_ns"]))
    chosen = long.take(select_evenly(long.num_rows, STANCES_MAX))
    part, begin_ns, end_ns = (
        chosen[name].to_numpy() for name in ("part", "begin_t_ns", "end_t_ns")
    )
    rows = select_evenly(chosen.num_rows, curves)
    gathered = StanceOverlayBuilder(part, begin_ns, end_ns, points=points, rows=rows.tolist())
    if chosen.num_rows:
        names = ("t_ns", *OVERLAY_COLUMNS, *(("part",) if session.has_columns("part") else ()))
        begins_ns, ends_ns = (
            session.time_axis.shift_to_axis(t_ns, part) for t_ns in (begin_ns, end_ns)
        )
        groups = session.find_overlapping_row_groups(int(begins_ns.min()), int(ends_ns.max()) + 1)
        for piece in session.read_quantities(*names, row_groups=groups):
            gathered.add_frames(piece["t_ns"].astype(np.int64), piece)
    overlay = gathered.build_overlay()
    return SessionOverlay(
        overlay,
        tuple(chosen["number"].to_numpy()[overlay.rows].tolist()),
        whole_count=long.num_rows,
        overlaid_count=chosen.num_rows,
        partial_count=stances.num_rows - whole.num_rows,
        too_short_count=whole.num_rows - long.num_rows,
    )
