"""A stream as a session is made from it: what is known of it, wherever the session is made.

A *node's stream* (`NodeStream`) is what the node takes and keeps, a *server's stream*
(`ServerStream`) what a server has of it. Both, and a journal that is opened after a crash, give
the facts that are described here; ends, ledger and sources of a session follow from these alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from devices.frames import ArrayInfo
from storage.intervals import NO_END
from storage.journal.journal import Journal
from storage.sessions.ledger import StreamState


class Around(Protocol):
    """Looks up the frames next to an instant of a stream."""

    def __call__(
        self, t_ns: int, *, at_least: int, waiting: bool = False
    ) -> tuple[int, int] | None:
        """As `around_in`; `waiting`: what was found may be given while frames between may come."""


@dataclass(frozen=True)
class SessionStream(StreamState):
    """What is known of one stream, for the sessions that it is part of.

    Attributes:
        info: description of its array; None: not known.
        journal: its frames; None: there are none.
        around: looks up the frames next to an instant.
        offset_ns: what to add to its instants for those of the clock by which sessions are
            stopped; None: not known, or no session ends by that clock.
        last_seen_t_ns: when a frame of it came last, by that clock; None: not known.
    """

    info: ArrayInfo | None = None
    journal: Journal | None = None
    around: Around | None = None
    offset_ns: int | None = None
    last_seen_t_ns: int | None = None

    def t_ns_near(self, seq: int, *, newest: bool) -> int | None:
        """Its own UTC of the newest frame held up to `seq`, or of the oldest from `seq` on."""
        return self.journal.t_ns_near(seq, newest=newest) if self.journal is not None else None


def around_in(
    journal: Journal, t_ns: int, *, at_least: int, waiting: bool = False
) -> tuple[int, int] | None:
    """Numbers held next to an instant of the node's UTC: the last until it, the first after.

    Args:
        journal: of the stream.
        t_ns: the instant.
        at_least: earlier numbers do not count; the last is `at_least` - 1 if there is none.
        waiting: makes no difference here, for nothing is remembered.

    Returns:
        Both; None while the stream has not passed the instant.

    Raises:
        DamagedFramesError: the frames that tell are damaged.
    """
    last = journal.last_seq_until(t_ns, at_least=at_least)
    if last is None:
        return None
    return last, next(iter(journal.held.within(last + 1, NO_END)))[0]
