"""The index of sessions: at any time what a walk over all of them would find."""

from __future__ import annotations

from typing import get_args

from hypothesis import given
from hypothesis import strategies as st

from service.server.session_store import SessionIndex, start_key
from storage.sessions.folder import Part, Session, SessionState

NODES = ("left", "right")


def session(number: int, started_t_ns: int, node: str, state: SessionState) -> Session:
    part = Part(stream_id="0" * 32, seq_first=0)
    return Session(
        id=f"20261122T000000Z-{number:06x}",
        name="walk",
        node=node,
        state=state,
        started_t_ns=started_t_ns,
        parts=(part,),
        scene="mud",
    )


sessions = st.builds(
    session,
    st.integers(0, 6),
    st.integers(0, 3),  # started at one instant, or once more at another: restored by hand
    st.sampled_from(NODES),
    st.sampled_from(get_args(SessionState)),
)
changes = st.lists(st.tuples(st.booleans(), sessions), max_size=30)


@given(st.lists(sessions, max_size=6), changes)
def test_whatever_comes_and_goes_the_index_tells_what_a_walk_over_all_sessions_would(
    first: list[Session], changes: list[tuple[bool, Session]]
) -> None:
    index, known = SessionIndex(first), {each.id: each for each in first}
    for goes, each in changes:
        if not goes:
            index.put(each)
            known[each.id] = each
        elif each.id in known:
            assert index.remove(each.id) == known.pop(each.id)
        newest_first = sorted(known.values(), key=start_key, reverse=True)
        assert list(index.iterate_newest_first()) == newest_first
        before = start_key(each)
        assert list(index.iterate_newest_first(before)) == [
            s for s in newest_first if start_key(s) < before
        ]
        for node in (None, *NODES):
            unsealed = {s.id for s in known.values() if s.state != "sealed"}
            unsealed &= {s.id for s in known.values() if node in (None, s.node)}
            assert {s.id for s in index.list_unsealed(node)} == unsealed
        assert (len(index), each.id in index) == (len(known), each.id in known)
