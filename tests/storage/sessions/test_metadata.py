"""Which sessions are meant: by node, tag, take, text, time and completeness."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import UsageError
from storage.sessions.folder import Completeness, Part, Session
from storage.sessions.metadata import SessionFilter, parse_completeness, parse_iso_or_t_ns

T_NS = 1_767_225_600_000_000_000
"""2026-01-01T00:00:00Z"""


def session(**said: object) -> Session:
    content: dict[str, object] = {
        "id": "20260101T000000Z-000000",
        "name": "trial",
        "node": "left",
        "state": "recording",
        "started_t_ns": T_NS,
        "parts": (Part(stream_id="0" * 32, seq_first=0),),
        "scene": "standing",
    }
    return Session.model_validate(content | said)


def chosen(choice: SessionFilter, one: Session, complete: Completeness = True) -> bool:
    return choice.accepts(one, lambda _: complete)


def test_no_filter_accepts_every_session() -> None:
    assert chosen(SessionFilter(), session())


def test_one_of_the_nodes_and_all_tags_are_needed() -> None:
    one = session(tags=("Mud", "third"))
    assert chosen(SessionFilter(nodes=("right", "left")), one)
    assert not chosen(SessionFilter(nodes=("lef",)), one)
    assert chosen(SessionFilter(tags=("mud", " THIRD ")), one)
    assert not chosen(SessionFilter(tags=("mud", "fourth")), one)
    assert not chosen(SessionFilter(tags=("mu",)), one)


def test_a_time_range_has_its_begin_and_not_its_end() -> None:
    assert chosen(SessionFilter(from_t_ns=T_NS, to_t_ns=T_NS + 1), session())
    assert not chosen(SessionFilter(from_t_ns=T_NS + 1), session())
    assert not chosen(SessionFilter(to_t_ns=T_NS), session())


@pytest.mark.parametrize("wanted", [True, False, "lossy"])
@pytest.mark.parametrize("found", [True, False, "lossy"])
def test_sessions_are_filtered_by_completeness(wanted: Completeness, found: Completeness) -> None:
    assert chosen(SessionFilter(complete=wanted), session(), found) == (wanted == found)


def test_frames_of_excluded_sessions_are_not_counted() -> None:
    def counting(_: Session) -> Completeness:
        pytest.fail("it is of another node")

    assert not SessionFilter(nodes=("right",), complete=True).accepts(session(), counting)


@given(
    st.datetimes(datetime(1970, 1, 2), datetime(2261, 1, 1)),  # as it is written
    st.integers(-23 * 60, 23 * 60),
)
def test_a_time_is_the_same_in_each_notation(at: datetime, offset_minutes: int) -> None:
    utc = at.replace(tzinfo=UTC)
    t_ns = parse_iso_or_t_ns(utc.isoformat(), where="from")
    assert datetime.fromtimestamp(t_ns // 10**9, UTC) == utc.replace(microsecond=0)
    assert t_ns % 10**9 == utc.microsecond * 1000
    elsewhere = utc.astimezone(timezone(timedelta(minutes=offset_minutes)))
    for written in (at.isoformat(), elsewhere.isoformat(), str(at), f" {at.isoformat()}Z"):
        assert parse_iso_or_t_ns(written, where="from") == t_ns
    if t_ns >= 10**8:
        assert parse_iso_or_t_ns(str(t_ns), where="from") == t_ns


def test_a_date_is_its_midnight() -> None:
    assert parse_iso_or_t_ns("2026-01-01", where="from") == T_NS


@pytest.mark.parametrize(
    "said",
    [
        *("", "yesterday", "2026", "2026-13-01", "-5", "1969-12-31", "9999-01-01", "9" * 400),
        *("NaN", "1e18", "2026-01-01T00:00:00 01:00", "\N{FULLWIDTH DIGIT ONE}" * 10),
    ],
)
def test_what_is_no_time_is_refused_with_an_example(said: str) -> None:
    with pytest.raises(UsageError, match="is no instant") as refused:
        parse_iso_or_t_ns(said, where="--from")
    assert "--from" in str(refused.value)
    assert "2026-11-24T08:00" in str(refused.value)


def test_a_completeness_is_one_of_three_words() -> None:
    assert [parse_completeness(said, where="x") for said in ("true", "false", "lossy")] == [
        True,
        False,
        "lossy",
    ]
    with pytest.raises(UsageError, match="true, false or lossy"):
        parse_completeness("True", where="--complete")
