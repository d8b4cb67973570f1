"""What is known of a server's session as of now: its ledger, and what it is made from."""

from __future__ import annotations

from contextlib import suppress

from devices.errors import FootTileError
from service.server import following
from service.server.node import ServerNode
from service.sessions.ends import at_stop
from service.sessions.sources import Sources, sources_of
from service.sessions.streams import SessionStream
from storage.sessions.folder import Ledger, Session
from storage.sessions.ledger import ledger_of, numbers_of, states_of


def ledger_now(session: Session, node: ServerNode | None) -> Ledger:
    """What became of every frame of a session."""
    if session.state == "sealed" and session.ledger is not None:
        return session.ledger
    finished = session.stopped_t_ns is not None and session.parts[-1].seq_last is not None
    about, streams = _provisional(session, node)
    return ledger_of(about.parts, states_of(about, streams), finished=finished)


def sources_now(session: Session, node: ServerNode) -> Sources:
    """What a session is made from, sealed or given away before."""
    session, streams = _provisional(session, node)
    return sources_of(
        session,
        streams,
        tares=lambda: node.tares,
        emulated=node.hello.emulated,
        no_array=node.info,
    )


def is_all_here(session: Session, node: ServerNode | None) -> bool:
    """Is nothing more to come, and what is here on the disk?"""
    if session.parts[-1].seq_last is None:
        return False
    for boot_id, numbers in numbers_of(session.parts).items():
        stream = node.streams.get(boot_id) if node is not None else None
        if stream is not None and stream.unsynced & numbers:
            return False
    return not any(part.pending for part in ledger_now(session, node).parts)


def _provisional(
    session: Session, node: ServerNode | None
) -> tuple[Session, dict[str, SessionStream]]:
    """A session with the end that it will have nearly, and its streams."""
    streams = following.streams_of(session, node)
    with suppress(FootTileError):  # the frames that tell are damaged
        session = at_stop(session, streams)
    return session, streams
