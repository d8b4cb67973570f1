"""Clocks of unsealed sessions: measurements of their nodes' clocks, beside the server's."""

from __future__ import annotations

import logging

from devices.errors import StorageError
from service.protocol.link import ClockSample
from service.server.node import ServerNode
from service.server.nodes import NodeRegistry
from service.server.session_store import SessionStore
from storage.sessions.folder import Session

log = logging.getLogger("foottile.recorder")

CLOCK_ERROR_MAX_NS = 60_000_000_000
"""Tolerance: eight probes take up to 40 s on a very poor link."""


class SessionClocks:
    """Rows of the clock tables of unsealed sessions, cached with these, saved with their changes.

    Args:
        store: sessions of the server.
        nodes: nodes of the server.
    """

    def __init__(self, store: SessionStore, nodes: NodeRegistry) -> None:
        self._store = store
        self._nodes = nodes
        for session in store.list_unsealed():
            store.cache(self.add_missing_rows(session))

    def cache_missing_rows(self, node: ServerNode) -> None:
        """Add missing clock measurements to a node's unsealed sessions, in memory.

        Measurements are missing after a first contact, and for streams into which a session was
        extended.
        """
        for session in self._store.list_unsealed(node.name):
            if session.state != "sealing":
                self._store.cache(self.add_missing_rows(session))

    def record_plausible_row(self, node: ServerNode, row: ClockSample, now_t_ns: int) -> None:
        """Record a plausible measurement of a node's clock, in its stream and its sessions.

        A measurement is dropped if its server time is far from the present time, or its node time
        far from the clock that the hello stated. Others go into the stream's log at once; sessions
        are saved with their next change.
        """
        stated_t_ns = row.t_mono_ns + node.last_info.utc_offset_ns + row.server_minus_node_ns
        if abs(stated_t_ns - now_t_ns) > CLOCK_ERROR_MAX_NS + row.uncertainty_ns:
            log.warning(
                "node %s: a measurement of its clock is not kept: it has this server's clock "
                "%.0f s off. Was that set just now?",
                node.name,
                (stated_t_ns - now_t_ns) * 1e-9,
            )
            return
        limit = node.present_stream.limit
        if limit is not None and not limit.is_near_stated_clock(
            row.t_mono_ns, row.uncertainty_ns, now_t_ns
        ):
            log.warning(
                "node %s: a measurement of its clock is not kept: its time is not the one that the "
                "node stated at connecting",
                node.name,
            )
            return
        try:
            node.present_stream.record_clock_offset(row)
        except StorageError as error:  # the measurement is used all the same
            log.warning("node %s: %s", node.name, error)
        offset = node.present_stream.clock_offsets[-1]
        for session in self._store.list_unsealed(node.name):
            is_its_own = any(part.stream_id == node.stream_id for part in session.parts)
            if is_its_own and session.state != "sealing":
                clock = (*session.clock, offset)
                self._store.cache(session.model_copy(update={"clock": clock}))

    def add_missing_rows(self, session: Session) -> Session:
        """Return an unsealed session with the rows of its streams that it lacks."""
        node = self._nodes.find(session.node)
        if session.state == "sealed" or node is None:
            return session
        try:
            for stream_id in dict.fromkeys(part.stream_id for part in session.parts):
                stream = node.streams.get(stream_id)
                times_ns = [row.t_mono_ns for row in session.clock if row.stream_id == stream_id]
                # A log may be long: read it only if the session lacks its newest row.
                if (
                    stream is not None
                    and stream.clock_offsets
                    and (stream.clock_offsets[-1].t_mono_ns > max(times_ns, default=-1))
                ):
                    session = session.with_newer_clock_rows(stream.read_clock_offsets())
        except StorageError as error:  # frames matter more than clock measurements
            log.warning("session %s: %s", session.id, error)
        return session
