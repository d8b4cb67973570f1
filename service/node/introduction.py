"""How a node introduces itself to a server: the stream that is being taken, and earlier ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

from service.link import PROTOCOL, EarlierStream, Hello
from storage.journal.node_journal import NodeJournal
from storage.journal.node_stream import NodeStream

if TYPE_CHECKING:
    from service.node.run import NodeOptions

_EARLIER_MAX = 64
"""As many as fit into a message."""


def hello_of(options: NodeOptions, journal: NodeJournal, present: NodeStream) -> Hello:
    """What a node says of itself; it looks into the journals of earlier streams.

    Raises:
        StorageError: one of them cannot be read.
    """
    next_seq = present.next_seq  # before what is held, which may go on meanwhile
    others = [stream for stream in journal.streams if stream is not present]
    # Those that a session waits for first, then the newest.
    waited_for = [stream for stream in others if journal.undelivered(stream)]
    rest = [stream for stream in others if stream not in waited_for]
    chosen = (*waited_for[:_EARLIER_MAX], *rest[-_EARLIER_MAX:])[:_EARLIER_MAX]
    earlier = [stream for stream in others if stream in chosen]
    return Hello(
        protocol=PROTOCOL,
        array_info=present.info,
        held=tuple(present.held),
        next_seq=next_seq,
        lost=present.lost.as_pairs(),
        scene=options.rig.scene.model_dump(mode="json"),
        emulated=options.rig.emulated,
        calibration=options.calibration,
        calibration_problem=options.calibration_problem,
        earlier=tuple(_earlier(stream) for stream in earlier),
        has_more=len(earlier) < len(others),
    )


def _earlier(stream: NodeStream) -> EarlierStream:
    held, journal = stream.held, stream.journal
    t_ns_first = journal.t_ns_near(0, newest=False) if journal is not None else None
    return EarlierStream(
        array_info=stream.info,
        held=tuple(held),
        next_seq=stream.next_seq,
        lost=stream.lost.as_pairs(),
        unsynced_tail_max=stream.notes.unsynced_tail_max,
        missed_slots=stream.missed_slots,
        t_ns_first=t_ns_first or 0,
    )
