"""In-memory index of sessions: by id, by start time, and unsealed ones.

A season has thousands of sessions, and nearly all are sealed. A tick visits the unsealed ones only;
a page of the list visits the sessions on that page.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterable, Iterator

from storage.sessions.folder import Session

StartKey = tuple[int, str]
"""Sort key of sessions: start time, ns UTC, and id."""


def start_key(session: Session) -> StartKey:
    """Return the sort key of a session."""
    return session.started_t_ns, session.id


class SessionIndex:
    """Sessions by id and by start time.

    Args:
        sessions: initial content.
    """

    def __init__(self, sessions: Iterable[Session] = ()) -> None:
        self._by_id = {session.id: session for session in sessions}
        self._keys = sorted(map(start_key, self._by_id.values()))
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
        """Add a session, or replace the one with its id."""
        previous = self._by_id.get(session.id)
        if previous is None or start_key(previous) != start_key(session):
            if previous is not None:
                self.remove(session.id)
            insort(self._keys, start_key(session))
        self._by_id[session.id] = session
        if session.state == "sealed":
            self._unsealed.pop(session.id, None)
        else:
            self._unsealed[session.id] = session

    def remove(self, session_id: str) -> Session:
        """Remove a session and return it.

        Raises:
            KeyError: no session has this id.
        """
        session = self._by_id.pop(session_id)
        del self._keys[bisect_left(self._keys, start_key(session))]
        self._unsealed.pop(session_id, None)
        return session

    def list_unsealed(self, node: str | None = None) -> list[Session]:
        """Return unsealed sessions, of all nodes or of one, in order of addition."""
        return [each for each in self._unsealed.values() if node in (None, each.node)]

    def iterate_newest_first(self, before: StartKey | None = None) -> Iterator[Session]:
        """Yield all sessions, or those before a key, newest first; change none meanwhile."""
        end = len(self._keys) if before is None else bisect_left(self._keys, before)
        for place in range(end - 1, -1, -1):
            yield self._by_id[self._keys[place][1]]
