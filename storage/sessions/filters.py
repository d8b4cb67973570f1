"""Filter of sessions by node, tag, take, text, time and completeness."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from devices.errors import UsageError
from storage.sessions.folder import Completeness, Session

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_T_NS_END = 2**63


@dataclass(frozen=True)
class SessionFilter:
    """Filter of sessions; an empty field accepts every session.

    Attributes:
        nodes: names of nodes, one of which recorded the session.
        tags: tags that the session has, case-insensitive.
        take: id of its take.
        q: text in id, name, subject, notes, node, scene or a tag, case-insensitive.
        from_t_ns: earliest start, UTC.
        to_t_ns: end of the range of starts, exclusive, UTC.
        complete: completeness of the session.
    """

    nodes: tuple[str, ...] = ()
    tags: tuple[str, ...] = ()
    take: str | None = None
    q: str | None = None
    from_t_ns: int | None = None
    to_t_ns: int | None = None
    complete: Completeness | None = None

    def accepts(
        self, session: Session, get_completeness: Callable[[Session], Completeness]
    ) -> bool:
        """Return whether a session passes the filter.

        Args:
            session: the session now.
            get_completeness: returns a session's completeness; called last, since it may have to
                count.
        """
        tags = {tag.casefold() for tag in session.tags}
        return (
            (not self.nodes or session.node in self.nodes)
            and all(tag.strip().casefold() in tags for tag in self.tags)
            and (self.take is None or session.take == self.take)
            and (self.from_t_ns is None or session.started_t_ns >= self.from_t_ns)
            and (self.to_t_ns is None or session.started_t_ns < self.to_t_ns)
            and (self.q is None or _contains_text(session, self.q.casefold()))
            and (self.complete is None or get_completeness(session) == self.complete)
        )


def parse_iso_or_t_ns(text: str, *, where: str) -> int:
    """Parse an instant in ns since 1970, UTC: such a number, or an ISO 8601 date or time.

    Args:
        text: without an offset it is UTC; a date alone is its midnight.
        where: the option or parameter, for the message.

    Raises:
        UsageError: it is neither, or before 1970 or after 2261.
    """
    stripped = text.strip()
    is_number = re.fullmatch(r"[0-9]{9,}", stripped, re.ASCII)
    try:
        t_ns = int(stripped[:20]) if is_number else _parse_iso_t_ns(stripped)
    except (ValueError, OverflowError):
        t_ns = -1
    if not 0 <= t_ns < _T_NS_END:
        raise UsageError(
            f"{where} {text[:40]!r} is no instant",
            expected="2026-11-24, 2026-11-24T08:00, 2026-11-24T08:00:00Z, or nanoseconds "
            "since 1970; without an offset it is UTC",
        )
    return t_ns


def _parse_iso_t_ns(text: str) -> int:
    at = datetime.fromisoformat(text)
    at = at if at.tzinfo is not None else at.replace(tzinfo=UTC)
    return (at - _EPOCH) // timedelta(microseconds=1) * 1000


def parse_completeness(text: str, *, where: str) -> Completeness:
    """Parse `true`, `false` or `lossy`.

    Raises:
        UsageError: it is none of these.
    """
    values: dict[str, Completeness] = {"true": True, "false": False, "lossy": "lossy"}
    if text not in values:
        raise UsageError(f"{where} {text[:40]!r}", expected="true, false or lossy")
    return values[text]


def _contains_text(session: Session, q: str) -> bool:
    texts = (session.id, session.name, session.subject, session.notes, session.node, session.scene)
    return any(q in text.casefold() for text in (*texts, *session.tags))
