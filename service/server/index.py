"""Sessions by id, by age, and those that are not sealed yet: updated by each, walked by none.

A season has thousands of sessions, and nearly all are sealed. What looks at every tick looks at the
few that are not; a page of the list costs what is on it.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterable, Iterator

from storage.sessions.folder import Session

Age = tuple[int, str]
"""By what sessions are in order: when one was started, in ns UTC, and its id."""


def age_of(session: Session) -> Age:
    """Its place in the order."""
    return session.started_t_ns, session.id


class SessionIndex:
    """Sessions, each once.

    Args:
        sessions: those to begin with.
    """

    def __init__(self, sessions: Iterable[Session] = ()) -> None:
        self._by_id = {session.id: session for session in sessions}
        self._ages = sorted(map(age_of, self._by_id.values()))
        self._unsealed = {
            name: session for name, session in self._by_id.items() if session.state != "sealed"
        }

    def __contains__(self, session_id: object) -> bool:
        return session_id in self._by_id

    def __len__(self) -> int:
        return len(self._by_id)

    def __getitem__(self, session_id: str) -> Session:
        return self._by_id[session_id]

    def put(self, session: Session) -> None:
        """Add a session, or replace the one of its id."""
        known = self._by_id.get(session.id)
        if known is None or age_of(known) != age_of(session):
            if known is not None:
                self.take(session.id)
            insort(self._ages, age_of(session))
        self._by_id[session.id] = session
        if session.state == "sealed":
            self._unsealed.pop(session.id, None)
        else:
            self._unsealed[session.id] = session

    def take(self, session_id: str) -> Session:
        """Remove a session and return it.

        Raises:
            KeyError: there is none of this id.
        """
        session = self._by_id.pop(session_id)
        del self._ages[bisect_left(self._ages, age_of(session))]
        self._unsealed.pop(session_id, None)
        return session

    def unsealed(self, node: str | None = None) -> list[Session]:
        """Those that are not sealed, of all nodes or of one, in the order they came in."""
        return [each for each in self._unsealed.values() if node in (None, each.node)]

    def newest_first(self, before: Age | None = None) -> Iterator[Session]:
        """All, or those before one, newest first; put and take nothing meanwhile."""
        end = len(self._ages) if before is None else bisect_left(self._ages, before)
        for place in range(end - 1, -1, -1):
            yield self._by_id[self._ages[place][1]]
