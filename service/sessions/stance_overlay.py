"""Stances of a sealed session one upon another, from its file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from devices.errors import UnknownError
from service.estimation.stance_overlay import OVERLAID, Overlay, StanceOverlay, evenly
from storage.sessions.reader import SessionReader

STANCES_MAX = 4000
"""Of more stances than this so many are overlaid, evenly over the session: two seconds of work."""


@dataclass(frozen=True)
class SessionOverlay:
    """The whole stances of a session, one upon another.

    Attributes:
        overlay: them.
        numbers: of the stances that are there one by one, in the order of its rows.
        whole: how many stances could be overlaid.
        overlaid: how many of them mean and spread are of: all, or `STANCES_MAX`.
        not_whole: how many are left out since they were not seen whole.
        too_short: how many are left out since they are one frame, and last no time.
    """

    overlay: Overlay
    numbers: tuple[int, ...]
    whole: int
    overlaid: int
    not_whole: int
    too_short: int


def overlay_of_session(
    session: SessionReader, stances: pa.Table, *, points: int, curves: int
) -> SessionOverlay:
    """Lay the stances of a sealed session one upon another.

    Args:
        session: its frames, open for slices.
        stances: of `service.sessions.stances.stances_of_session`.
        points: percentages of the duration, from 0 to 100.
        curves: how many stances are there one by one at the most, evenly over the session.

    Raises:
        UnknownError: it has no estimates of all that is overlaid.
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
    taken = long.take(evenly(long.num_rows, STANCES_MAX))
    part, begin_ns, end_ns = (taken[name].to_numpy() for name in ("part", "begin_t_ns", "end_t_ns"))
    rows = evenly(taken.num_rows, curves)
    gathered = StanceOverlay(part, begin_ns, end_ns, points=points, rows=rows.tolist())
    if taken.num_rows:
        names = ("t_ns", *OVERLAID, *(("part",) if session.has("part") else ()))
        begins_ns, ends_ns = (session.axis.at(t_ns, part) for t_ns in (begin_ns, end_ns))
        groups = session.groups_within(int(begins_ns.min()), int(ends_ns.max()) + 1)
        for piece in session.columns(*names, groups=groups):
            gathered.feed(piece["t_ns"].astype(np.int64), piece)
    overlay = gathered.finish()
    return SessionOverlay(
        overlay,
        tuple(taken["number"].to_numpy()[overlay.rows].tolist()),
        whole=long.num_rows,
        overlaid=taken.num_rows,
        not_whole=stances.num_rows - whole.num_rows,
        too_short=whole.num_rows - long.num_rows,
    )
