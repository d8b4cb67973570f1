"""Overlay of a sealed session's stances, from its file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from devices.errors import UnknownError
from service.estimation.stance_overlay import OVERLAID, Overlay, StanceOverlay, evenly
from storage.sessions.reader import SessionReader

STANCES_MAX = 4000
"""Limit of overlaid stances, evenly spread over the session: two seconds of work."""


@dataclass(frozen=True)
class SessionOverlay:
    """Overlay of the whole stances of a session.

    Attributes:
        overlay: curves, mean and spread.
        numbers: numbers of the stances with single curves, in the order of its rows.
        whole: number of stances that could be overlaid.
        overlaid: number of stances in mean and spread: all, or `STANCES_MAX`.
        not_whole: number of stances left out as incomplete.
        too_short: number of stances left out as single frames without duration.
    """

    overlay: Overlay
    numbers: tuple[int, ...]
    whole: int
    """number of stances that could be overlaid."""
    overlaid: int
    """number of stances in mean and spread: all, or `STANCES_MAX`."""
    not_whole: int
    """number of stances left out as incomplete."""
    too_short: int
    """number of stances left out as single frames without duration."""


def overlay_of_session(
    session: SessionReader, stances: pa.Table, *, points: int, curves: int
) -> SessionOverlay:
    """Overlay the stances of a sealed session.

    Args:
        session: frames of the session, open for slices.
        stances: table of `service.sessions.stances.stances_in`.
        points: number of percentages of the duration, from 0 to 100.
        curves: limit of single curves, evenly spread over the session.

    Raises:
        UnknownError: it lacks estimates of an overlaid quantity.
        FileFormatError: it is damaged.
    """
    if absent := [name for name in OVERLAID if not session.has(name)]:
        raise UnknownError(
            f"stances cannot be overlaid without {', '.join(absent)}",
            where=str(session.path),
            remedy="`foottile estimate` makes them",
        )
    whole = stances.filter(stances["is_whole"])
    long = whole.filter(pc.greater(whole["end_t_ns"], whole["begin_t_ns"]))
    chosen = long.take(evenly(long.num_rows, STANCES_MAX))
    part, begin_ns, end_ns = (
        chosen[name].to_numpy() for name in ("part", "begin_t_ns", "end_t_ns")
    )
    rows = evenly(chosen.num_rows, curves)
    gathered = StanceOverlay(part, begin_ns, end_ns, points=points, rows=rows.tolist())
    if chosen.num_rows:
        names = ("t_ns", *OVERLAID, *(("part",) if session.has("part") else ()))
        begins_ns, ends_ns = (session.axis.at(t_ns, part) for t_ns in (begin_ns, end_ns))
        groups = session.groups_within(int(begins_ns.min()), int(ends_ns.max()) + 1)
        for piece in session.columns(*names, groups=groups):
            gathered.feed(piece["t_ns"].astype(np.int64), piece)
    overlay = gathered.finish()
    return SessionOverlay(
        overlay,
        tuple(chosen["number"].to_numpy()[overlay.rows].tolist()),
        whole=long.num_rows,
        overlaid=chosen.num_rows,
        not_whole=stances.num_rows - whole.num_rows,
        too_short=whole.num_rows - long.num_rows,
    )
