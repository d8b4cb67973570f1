"""Edges of a node's sync line as markers of its sessions.

A session has its first 10,000 edges between its first and last frame. They come from the journal of
the frames, so each occurs once after resends and restarts.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from devices.frames import ArrayInfo, Edge
from devices.scene.hardware_sections import SyncSection
from service.sessions.inputs import SessionInputs
from storage.clock.table import ClockTable
from storage.intervals import Intervals
from storage.schema import UNKNOWN_T_NS
from storage.sessions.folder import Marker, Session

EDGE_MARKERS_MAX = 10_000
"""Most edges of a session that become markers, the first ones: an edge a second for hours."""


class EdgeMarkers(NamedTuple):
    """Edges of a session."""

    markers: tuple[Marker, ...] = ()
    problem: str | None = None
    """Description of missing edges; None: none is known to be missing."""


def read_sync_section(session: Session) -> SyncSection | None:
    """Return the section of the session's scene; None without a sync input."""
    try:
        section = SyncSection.model_validate(session.scene_content.get("sync"))
    except ValidationError:
        return None
    return section if section.input_line is not None else None


def collect_edge_markers(inputs: SessionInputs) -> EdgeMarkers:
    """Collect the edges of a session from its journals.

    Raises:
        FootTileError: a journal is damaged, or cannot be read.
    """
    section = read_sync_section(inputs.session)
    if section is None:
        return EdgeMarkers()
    found: list[Marker] = []
    lost = further = 0
    clock = inputs.make_clock_table()
    for span in inputs.find_part_spans():
        part, journal = inputs.session.parts[span.number], inputs.journals[span.stream_id]
        seq_last = journal.stored.last if part.seq_last is None else part.seq_last
        begin_ns, end_ns = span.t_mono_ns
        # Of an endless pulse train only the numbers and the first edges are kept. A message that
        # was cut or came twice repeats edges of its neighbours, so these come not quite in order.
        numbers, first = Intervals(), list[Edge]()
        for edge in journal.read_edges(part.seq_first, seq_last or 0):
            number = edge.number
            if begin_ns <= edge.t_mono_ns <= end_ns and not numbers.restricted_to(number, number):
                numbers.add(number, number)
                if len(first) < 2 * EDGE_MARKERS_MAX:
                    first.append(edge)
        edges = sorted(first)[: EDGE_MARKERS_MAX - len(found)]
        lost += sum(begin - end - 1 for (_, end), (begin, _) in pairwise(numbers))
        further += numbers.number_count - len(edges)
        found += make_edge_markers(edges, section, journal.info, clock, span.number)
    problems = []
    if lost:
        problems.append(f"{lost} edges of the sync line are lost: too many at once, or with frames")
    if further:
        problems.append(
            f"{further} edges of the sync line are no markers, beyond {EDGE_MARKERS_MAX}"
        )
    return EdgeMarkers(tuple(found), "; ".join(problems) or None)


def make_edge_markers(
    edges: Sequence[Edge], section: SyncSection, info: ArrayInfo, clock: ClockTable, part: int
) -> list[Marker]:
    """Return edges of one stream as markers, in the server's time where that is known.

    Args:
        edges: edges of the stream.
        section: section of the scene.
        info: description of the stream's array.
        clock: clock table.
        part: a part of the stream in that table.
    """
    t_mono_ns = np.array([edge.t_mono_ns for edge in edges], dtype=np.int64)
    t_ns = t_mono_ns + info.utc_offset_ns
    parts = np.full(len(edges), part, dtype=np.uint16)
    times = clock.compute_server_time_columns_or_unknown(t_mono_ns, t_ns, parts)
    is_known = times["t_server_ns"] != UNKNOWN_T_NS
    at_ns = np.where(is_known, times["t_server_ns"], t_ns).tolist()
    bound_ns = (times["t_server_uncertainty_ns"] + section.bound_ns).tolist()
    return [
        Marker(
            id=f"{info.stream_id}-{edge.number}",
            label=_label_edge(edge, section),
            t_ns=at_ns[row],
            stream_id=info.stream_id,
            t_mono_ns=edge.t_mono_ns,
            bound_ns=bound_ns[row] if is_known[row] else None,
        )
        for row, edge in enumerate(edges)
    ]


def _label_edge(edge: Edge, section: SyncSection) -> str:
    if section.edge != "both":
        return section.label
    return f"{section.label} {'rising' if edge.is_rising else 'falling'}"
