"""Who lets whom in: tickets at the server's start and of `invite`, certificates, other machines."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
import segno

from service.api import address as interfaces
from service.api.access import Logins, Role
from service.cli.commands.serve import print_addresses
from service.cli.tickets import make_qr_lines, remark_unreachable
from service.protocol.link import compute_fingerprint
from tests.service.cli.outcome import Outcome, Run
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, ServeWith, closed
from tests.service.strangers import tls_before

TOKEN = "a-token-of-this-test"  # noqa: S105  # of this test
AWAY = "http://192.168.4.1:8000"
_LIGHT_ABOVE_BELOW = {"█": (1, 1), "▀": (1, 0), "▄": (0, 1), " ": (0, 0)}


def test_a_code_is_drawn_with_light_blocks_module_by_module() -> None:
    text = f"{AWAY}/#ticket=0123456789abcdefABCDEF"
    rows: list[list[int]] = []
    for line in make_qr_lines(text):
        halves = [_LIGHT_ABOVE_BELOW[block] for block in line]
        rows += [[above for above, _ in halves], [below for _, below in halves]]
    border = 2
    drawn = [row[border:-border] for row in rows[border:-border]]
    dark = [list(row) for row in segno.make(text, error="l", micro=False).matrix]
    assert [[1 - light for light in row] for row in drawn[: len(dark)]] == dark
    assert {light for row in rows[:border] for light in row} == {1}  # readers need a margin


def test_a_code_of_ascii_has_the_same_modules() -> None:
    text = f"{AWAY}/#ticket=0123456789abcdefABCDEF"
    drawn = make_qr_lines(text, is_ascii=True)
    assert all(line.isascii() for line in drawn)
    rows = [[line[at : at + 2] == "##" for at in range(0, len(line), 2)] for line in drawn]
    dark = [list(row) for row in segno.make(text, error="l", micro=False).matrix]
    assert [[not light for light in row[2:-2]] for row in rows[2:-2]] == dark
    assert all(all(row) for row in (*rows[:2], *rows[-2:]))


def announced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], url: str, **how: bool
) -> tuple[str, Logins]:
    logins = Logins(TOKEN)
    print_addresses([url], tmp_path, logins, is_stored=True, **how)
    return capsys.readouterr().out, logins


def tickets_of(logins: Logins) -> int:
    return len(logins.tickets._grants)


def test_a_server_that_phones_reach_shows_a_code_on_a_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    shown, logins = announced(tmp_path, capsys, AWAY)
    assert f"{AWAY}/#token={TOKEN}" in shown
    assert "█▀" in shown
    assert tickets_of(logins) == 1


def test_a_log_gets_neither_code_nor_token(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown, logins = announced(tmp_path, capsys, AWAY)
    assert shown == f"FootTile is at {AWAY}/\n"
    assert tickets_of(logins) == 0


def test_a_demo_gives_its_log_a_link_that_logs_in_once_and_no_token(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown, logins = announced(tmp_path, capsys, AWAY, is_demo=True)
    link, _, ticket = shown.strip().partition("#ticket=")
    assert link == f"FootTile is at {AWAY}/"
    given = logins.tickets.redeem(ticket)
    assert given is not None
    assert given.role is Role.OPERATOR
    assert TOKEN not in shown


@pytest.mark.parametrize("url", ["http://127.0.0.1:8000", "http://[::1]:8000"])
def test_a_server_that_no_phone_reaches_shows_no_code(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    url: str,
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    shown, logins = announced(tmp_path, capsys, url)
    assert "█" not in shown
    assert tickets_of(logins) == 0


@pytest.mark.parametrize(
    ("host", "url", "addresses", "word"),
    [
        ("0.0.0.0", "http://127.0.0.1:8000", [], "no network"),  # noqa: S104  # nothing listens
        ("0.0.0.0", "http://127.0.0.1:8000", ["fe80::1%eth0"], "--host ::"),  # noqa: S104  # same
        ("::", "http://[fe80::1%25eth0]:8000", ["fe80::1%eth0"], "the other machine's"),
        ("0.0.0.0", AWAY, ["192.168.4.1"], ""),  # noqa: S104  # nothing listens
        ("127.0.0.1", "http://127.0.0.1:8000", [], ""),
    ],
)
def test_what_keeps_others_away_is_remarked(
    host: str,
    url: str,
    addresses: list[str],
    word: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(interfaces, "list_addresses", lambda *, include_ipv6: addresses)
    remark_unreachable([url], host)
    said = capsys.readouterr().err
    assert word in said
    assert bool(said) is bool(word)


@pytest.mark.parametrize(("option", "role"), [((), "operator"), (("--read-only",), "viewer")])
def test_ticket_prints_an_address_that_lets_in_who_opens_it(
    serve_with: ServeWith,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    option: tuple[str, ...],
    role: str,
) -> None:
    running = serve_with(token=TOKEN)
    (tmp_path / "token").write_text(TOKEN + "\n")
    monkeypatch.delenv("FOOTTILE_TOKEN", raising=False)
    done = run("invite", "--server", running.url, "--data", str(tmp_path), *option).succeeds()
    address, _, ticket = done.out.strip().partition("#ticket=")
    assert address == running.url + "/"
    assert "--host 0.0.0.0" in done.err
    answer = httpx.post(f"{address}api/v1/login", json={"ticket": ticket}, trust_env=False)
    assert answer.json()["role"] == role


def test_ticket_as_json_by_the_token_of_the_environment(
    serve_with: ServeWith, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = serve_with(token=TOKEN)
    monkeypatch.setenv("FOOTTILE_TOKEN", TOKEN)
    done = run("invite", "--server", running.url, "--json")
    assert json.loads(done.out)["role"] == "operator"
    assert TOKEN not in done.out


def test_a_ticket_without_the_token_names_the_missing_token(
    serve_with: ServeWith, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = serve_with(token=TOKEN)
    monkeypatch.delenv("FOOTTILE_TOKEN")
    run("invite", "--server", running.url).fails(1, "needs the server's token", "FOOTTILE_TOKEN")
    run("invite", "--server", running.url, "--data", tmp_path).fails(2, "no token", "--data")


def test_a_private_server_is_read_with_its_token(
    serve_with: ServeWith, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = serve_with(token=TOKEN, is_private=True)
    monkeypatch.delenv("FOOTTILE_TOKEN", raising=False)
    refused = run("sessions", "--server", running.url)
    assert refused.code == 1
    assert "private" in refused.err
    monkeypatch.setenv("FOOTTILE_TOKEN", TOKEN)
    assert run("sessions", "--server", running.url).code == 0


# --- certificates, and strangers that answer ------------------------------------------------------


ASKING: tuple[tuple[tuple[str, ...], int, str], ...] = (
    (("sessions",), 0, ""),
    (("invite",), 0, ""),
    (("stream", "nobody"), 2, "no node 'nobody'"),
    (("pull", "20200101T000000Z-000000", "--out", "."), 1, "no session '20200101T000000Z-000000'"),
)
"""Commands that ask a server, with the code and the words of its answer."""


@pytest.mark.parametrize(("words", "code", "says"), ASKING)
def test_a_ca_is_named_with_an_option(
    serve_with: ServeWith,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    code: int,
    says: str,
) -> None:
    monkeypatch.setenv("FOOTTILE_TOKEN", TOKEN)
    with tls_before(serve_with(token=TOKEN).port, tmp_path / "tls") as url:
        refused = run(*words, "--server", url)
        assert refused.code == 1
        assert "--ca" in refused.err
        trusted = run(*words, "--server", url, "--ca", tmp_path / "tls" / "ca.pem")
    trusted.fails(code, says)
    assert "certificate" not in trusted.err


# --- machines of nodes ----------------------------------------------------------------------------


Accept = Callable[..., Outcome]


@pytest.fixture
def accept(run: Run, running: Running) -> Accept:
    return lambda *arguments: run("accept-node", *arguments, "--server", running.url)


@pytest.fixture
def stranger(running: Running, node: FakeNode, node_of: NodeOf) -> FakeNode:
    """Another machine, that was refused."""
    node.connect()
    node.leave()
    stranger = node_of(running)
    stranger.prove(secret=stranger.secret, proof=None)
    stranger.socket.send(stranger.hello().model_dump_json())
    assert closed(stranger.socket)[0] == 4013
    return stranger


def test_the_machine_that_asked_last_is_accepted_and_named(
    accept: Accept, stranger: FakeNode
) -> None:
    assert stranger.secret is not None
    outcome = accept("bench")
    assert (outcome.code, outcome.err) == (0, "")
    assert compute_fingerprint(stranger.secret) in outcome.out
    stranger.connect()
