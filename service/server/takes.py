"""Takes: several nodes recorded together, one session each, found by the take's id.

A take has no file: each session names its take. A failure on one node is reported for that node and
does not affect the others.
"""

from __future__ import annotations

import re
import secrets
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from devices.clock import server_utc_ns
from devices.errors import FootTileError, StateError, UnknownError
from service.server.nodes import NodeRegistry
from service.server.recorder import Recorder
from service.server.session_store import SessionStore
from storage.sessions.folder import IdempotencyRecord, Session

_ERRORS_KEPT = 1000
_FAILED_BEFORE = "it could not be recorded when this take was started"
TAKE_ID = re.compile(r"[0-9a-f]{12}")


@dataclass
class Take:
    """A take, or the result of a command on all of its sessions."""

    id: str
    sessions: list[Session] = field(default_factory=list)
    """One session of each node, and more for a node that came back with other tiles."""
    errors_by_node: dict[str, str] = field(default_factory=dict)
    """Error by node, where the command failed."""


class TakeRecorder:
    """Records, marks and stops several nodes together.

    Args:
        recorder: starts and stops sessions.
        store: all sessions.
        nodes: all nodes.
    """

    def __init__(self, recorder: Recorder, store: SessionStore, nodes: NodeRegistry) -> None:
        self._recorder = recorder
        self._store = store
        self._nodes = nodes
        self._errors_by_take: OrderedDict[str, dict[str, str]] = OrderedDict()
        """Errors of the nodes that could not be recorded, by take, the newest last."""

    def start_take_where_possible(
        self,
        name: str,
        nodes: Sequence[str] | None = None,
        *,
        pre_roll_s: float = 0.0,
        subject: str = "",
        notes: str = "",
        tags: tuple[str, ...] = (),
        request: IdempotencyRecord | None = None,
    ) -> Take:
        """Start a session on each node, with the same name.

        A repeated request creates nothing, not even on a node that failed then: it would begin at
        another time.

        Args:
            name: name of each session.
            nodes: names of the nodes; None: all connected ones.
            pre_roll_s: length of the pre-roll.
            subject: of each session.
            notes: of each session.
            tags: of each session.
            request: request with its idempotency key; None: without a key.

        Raises:
            StateError: no node could be recorded.
            UsageError: the key came with another request before.
        """
        if earlier := self._store.find_by_idempotency_key(request):
            return self._repeat_result(earlier, nodes or ())
        if nodes is None:
            nodes = sorted(node.name for node in self._nodes if node.is_connected)
        take = Take(secrets.token_hex(6))
        for node in dict.fromkeys(nodes):
            try:
                session = self._recorder.start_session(
                    node,
                    name,
                    pre_roll_s=pre_roll_s,
                    subject=subject,
                    notes=notes,
                    tags=tags,
                    take=take.id,
                    request=request,
                )
            except FootTileError as error:
                take.errors_by_node[node] = str(error)
            else:
                take.sessions.append(session)
        if not take.sessions:
            raise StateError(
                "no node is connected"
                if not take.errors_by_node
                else _format_errors(take.errors_by_node),
                remedy="Connect a node and retry",
            )
        if request is not None:
            self._errors_by_take[take.id] = take.errors_by_node
            while len(self._errors_by_take) > _ERRORS_KEPT:
                self._errors_by_take.popitem(last=False)
        return take

    def _repeat_result(self, sessions: list[Session], nodes: Sequence[str]) -> Take:
        take_id = str(sessions[0].take)
        recorded = {session.node for session in sessions}
        lacking = {node: _FAILED_BEFORE for node in nodes if node not in recorded}
        return Take(take_id, sessions, dict(self._errors_by_take.get(take_id, lacking)))

    def get_take(self, take_id: str) -> Take:
        """Return a take with its present sessions, by node; without those in the trash.

        Raises:
            UnknownError: no session names this take.
        """
        found = [one for one in self._store.iterate_newest_first() if one.take == take_id]
        if not TAKE_ID.fullmatch(take_id) or not found:
            raise UnknownError(f"no take {take_id[:80]!r}")
        return Take(take_id, sorted(found, key=lambda one: (one.node, one.started_t_ns)))

    def stop_take(self, take_id: str) -> Take:
        """Stop all of its sessions that are being recorded; stopped ones are unchanged.

        Raises:
            UnknownError: no session names this take.
            StateError: no session could be stopped.
        """
        take = self.get_take(take_id)
        for session in take.sessions:
            try:
                self._recorder.stop_session(session.id)
            except FootTileError as error:
                take.errors_by_node[session.node] = str(error)
        return self._require_success(take, take.sessions)

    def add_marker_to_recording_sessions(
        self, take_id: str, label: str, t_ns: int | None, marker_id: str | None = None
    ) -> Take:
        """Add a marker at one time to all of its sessions that are being recorded.

        Raises:
            UnknownError: no session names this take.
            StateError: no session is being recorded.
        """
        t_ns = server_utc_ns() if t_ns is None else t_ns
        marker_id = marker_id or secrets.token_hex(6)
        take = self.get_take(take_id)
        running = [one for one in take.sessions if one.state == "recording"]
        if not running:
            raise StateError(
                f"take {take_id} was stopped already",
                expected="a take that is being recorded",
            )
        for session in running:
            try:
                self._store.add_marker(session.id, label, t_ns, marker_id)
            except FootTileError as error:
                take.errors_by_node[session.node] = str(error)
        return self._require_success(take, running)

    def _require_success(self, take: Take, tried: Iterable[Session]) -> Take:
        done = [
            self._store.get_session(one.id) for one in tried if one.node not in take.errors_by_node
        ]
        if not done:
            raise StateError(_format_errors(take.errors_by_node))
        return Take(take.id, done, take.errors_by_node)


def _format_errors(failed: dict[str, str]) -> str:
    return "; ".join(dict.fromkeys(failed.values()))
