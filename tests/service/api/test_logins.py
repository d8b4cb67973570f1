"""Tickets and cookies as they are kept: by digest, for a time, in a number."""

from __future__ import annotations

import pytest

from service.api.logins import LOGINS_MAX, TICKET_S, TICKETS_MAX, Logins, Role, SecretStore


class Clock:
    def __init__(self) -> None:
        self.now_s = 1e6

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def logins(clock: Clock) -> Logins:
    return Logins("a-token-of-this-test", now_s=clock)


@pytest.mark.parametrize("right", list(Role))
def test_a_secret_is_good_for_the_right_it_was_given_for(logins: Logins, right: Role) -> None:
    secret = logins.cookies.create(right)
    for _ in range(2):
        found = logins.cookies.find_grant(secret)
        assert found is not None
        assert found.role is right


def test_a_ticket_is_good_once(logins: Logins) -> None:
    ticket = logins.tickets.create(Role.OPERATOR)
    assert logins.tickets.redeem(ticket) is not None
    assert logins.tickets.redeem(ticket) is None


def test_a_ticket_is_good_for_five_minutes(logins: Logins, clock: Clock) -> None:
    early, late = (logins.tickets.create(Role.VIEWER) for _ in range(2))
    clock.now_s += TICKET_S - 0.001
    assert logins.tickets.redeem(early) is not None
    clock.now_s += 0.002
    assert logins.tickets.redeem(late) is None


def test_what_is_like_a_secret_is_none(logins: Logins) -> None:
    ticket = logins.tickets.create(Role.OPERATOR)
    for other in (
        "",
        ticket[:-1],
        ticket + "A",
        ticket.swapcase(),
        " " + ticket,
        "\ud800",
        "x" * 99,
    ):
        assert logins.tickets.redeem(other) is None
    assert logins.tickets.redeem(ticket) is not None


def test_a_ticket_is_no_cookie_and_a_cookie_no_ticket(logins: Logins) -> None:
    ticket, cookie = logins.tickets.create(Role.OPERATOR), logins.cookies.create(Role.OPERATOR)
    assert logins.cookies.find_grant(ticket) is None
    assert logins.tickets.redeem(cookie) is None


@pytest.mark.parametrize(("kind", "most"), [("tickets", TICKETS_MAX), ("cookies", LOGINS_MAX)])
def test_there_are_only_so_many_and_the_oldest_goes(logins: Logins, kind: str, most: int) -> None:
    kept: SecretStore = getattr(logins, kind)
    secrets = [kept.create(Role.OPERATOR) for _ in range(most + 3)]
    assert [kept.find_grant(one) is not None for one in secrets] == [False] * 3 + [True] * most


def test_no_two_secrets_are_alike_and_none_is_kept(logins: Logins) -> None:
    tickets = {logins.tickets.create(Role.OPERATOR) for _ in range(TICKETS_MAX)}
    assert len(tickets) == TICKETS_MAX
    assert all(len(ticket) >= 22 for ticket in tickets)  # 128 bits
    kept = repr(vars(logins.tickets))
    assert not any(ticket in kept for ticket in tickets)
