"""`foottile serve --tls` as a process: programs, nodes and phones trust it, and no false server."""

from __future__ import annotations

import asyncio
import re
import signal
import socket
import ssl
import subprocess
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes

import foottile
from devices.errors import UsageError
from service.api.certificates import OwnAuthority
from service.api.settings import load_settings
from service.cli import server_tls
from tests.service.fake_node import FakeNode
from tests.service.node.publishing import Publishing
from tests.service.process import BIN, Process
from tests.service.running import Running
from tests.service.strangers import listening
from tests.tokens import SHARED_TOKEN
from tests.waiting import in_a_loop, until


def start(tmp_path: Path, *words: object, name: str = "server", **environment: str) -> Process:
    environment = {"XDG_STATE_HOME": str(tmp_path / "state"), **environment}
    return Process(*words, folder=tmp_path / name, **environment)


def find_word(line: str, begin: str) -> str:
    return next(word for word in line.split() if word.startswith(begin))


@pytest.mark.process
@pytest.mark.slow(parts=8)
def test_a_server_with_tls_is_trusted_by_its_user_and_by_whoever_has_its_ca(
    tmp_path: Path,
) -> None:
    data = tmp_path / "data"
    with closing(start(tmp_path, "serve", "--tls", "--port=0", "--data", data)) as server:
        url = find_word(server.said("FootTile is at"), "https://").rstrip("/")
        plain = find_word(server.said("have to trust it"), "http://")
        stated = server.said("compare there").partition("SHA-256 ")[2]
        ca = data / "tls" / "foottile-ca.crt"
        certificate = x509.load_pem_x509_certificate(ca.read_bytes())
        assert certificate.fingerprint(hashes.SHA256()).hex(" ").upper() == stated

        # A program with the CA; not one without, of another user.
        with foottile.connect(url, SHARED_TOKEN, ca=ca) as client:
            invited = client.create_invite()["urls"]
            assert all(each.startswith("https://127.0.0.1:") for each in invited)
        with (
            foottile.connect(url, SHARED_TOKEN) as client,
            pytest.raises(foottile.ServerUnavailableError, match=r"not trusted.*--ca"),
        ):
            client.nodes()

        # A login is for https only, and a browser is not told to stay there.
        context = ssl.create_default_context(cafile=ca)
        with httpx.Client(base_url=url, verify=context, trust_env=False) as browser:
            ticket = invited[0].partition("#ticket=")[2]
            answer = browser.post("/api/v1/login", json={"ticket": ticket}, headers={"Origin": url})
            assert answer.status_code == 200, answer.text
            assert "Secure" in answer.headers["set-cookie"]
            assert "strict-transport-security" not in answer.headers

        # Commands and nodes of this user need no --ca, whatever scheme is typed.
        for typed in (url, url.replace("https:", "http:"), url.replace("127.0.0.1", "localhost")):
            words = [str(BIN / "foottile"), "sessions", "--server", typed]
            environment = {"XDG_STATE_HOME": str(tmp_path / "state"), "PATH": "/usr/bin:/bin"}
            done = subprocess.run(words, env=environment, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
        words = ["node", "--scene=rolling", f"--server={url}"]
        with closing(start(tmp_path, *words, "--name=own", name="own")) as node:
            node.said("connected to wss://")
        state = {"XDG_STATE_HOME": str(tmp_path / "other")}
        with closing(start(tmp_path, *words, "--name=a", f"--ca={ca}", name="a", **state)) as node:
            node.said("connected to wss://")
        with closing(start(tmp_path, *words, "--name=b", name="b", **state)) as node:
            assert "--ca" in node.said("not trusted")

        # The plain port has the CA, and nothing else.
        with httpx.Client(base_url=plain, trust_env=False) as phone:
            page = phone.get("/")
            assert stated in page.text
            assert SHARED_TOKEN not in page.text
            assert "ticket" not in page.text
            loaded = phone.get("/foottile-ca.crt")
            assert loaded.headers["content-type"] == "application/x-x509-ca-cert"
            assert loaded.content == ca.read_bytes()
            for method, path in (
                ("GET", "/sessions?a=%20b"),
                ("POST", "/api/v1/login"),
                ("POST", "/"),
            ):
                led = phone.request(method, path)
                assert (led.status_code, led.headers["location"]) == (307, f"{url}{path}")
            assert phone.get("/", headers={"Host": "a b"}).status_code == 400
            assert phone.get("/x", headers={"a": "b" * 40000}).status_code == 431

        server.process.send_signal(signal.SIGINT)
        assert server.ended() == 0, server.err
    again = start(tmp_path, "serve", "--tls", "--port=0", "--data", data, name="again")
    with closing(again):
        assert again.said("compare there").endswith(stated)


@in_a_loop
async def test_no_token_is_sent_to_a_false_server(
    node: FakeNode, running: Running, tmp_path: Path
) -> None:
    now = datetime.now(UTC)
    pinned = OwnAuthority(tmp_path / "right", ["127.0.0.1"], now)
    false = OwnAuthority(tmp_path / "false", ["127.0.0.1"], now)
    false.certify(["127.0.0.1"], now)
    false.load()
    received: list[bytes] = []

    def answer(connection: socket.socket, _: object) -> None:
        with false.context.wrap_socket(connection, server_side=True) as secure:
            received.append(secure.recv(1 << 16))

    with listening(answer) as port:
        url = f"https://127.0.0.1:{port}"
        async with Publishing(node, url, ca=pinned.ca_path) as publishing:
            await publishing.until(lambda: publishing.reports)
        assert "not trusted" in publishing.reports[0]
        assert not any(received)
        # With the false CA it would have been sent: the test sees tokens.
        async with Publishing(node, url, ca=false.ca_path) as publishing:
            await publishing.until(lambda: any(received))
    assert any(SHARED_TOKEN.encode() in each for each in received)


def test_a_certificate_is_given_or_made(tmp_path: Path) -> None:
    given = {"tls_cert": tmp_path / "a", "tls_key": tmp_path / "b"}
    with pytest.raises(UsageError, match="choose one"):
        load_settings(None, tls=True, **given)
    with pytest.raises(UsageError, match="both --tls-cert and --tls-key"):
        load_settings(None, tls_cert=tmp_path / "a")
    assert load_settings(None, **given).tls_key == tmp_path / "b"


@in_a_loop
async def test_a_failed_renewal_is_said_once_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    asked = 0

    def list_announced() -> list[str]:
        nonlocal asked
        asked += 1
        raise RuntimeError("interfaces change")

    monkeypatch.setattr(server_tls, "_RENEWAL_PERIOD_S", 0.0)
    monkeypatch.setattr(server_tls, "remark", said.append)
    authority = OwnAuthority(tmp_path, ["localhost"], datetime.now(UTC))
    settings = load_settings(None, tls=True, data=tmp_path)
    renewing = asyncio.create_task(
        server_tls._renew_forever(authority, settings, list_announced, ())
    )
    while asked < 3 and not renewing.done():
        await asyncio.sleep(0.01)
    renewing.cancel()
    assert asked >= 3
    assert len(said) == 1


@in_a_loop
async def test_names_that_the_certificate_does_not_cover_are_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    announced = ["robot.example.org"]
    monkeypatch.setattr(server_tls, "_RENEWAL_PERIOD_S", 0.0)
    monkeypatch.setattr(server_tls, "remark", said.append)
    authority = OwnAuthority(tmp_path, ["localhost"], datetime.now(UTC))
    settings = load_settings(None, tls=True, data=tmp_path)
    names = [*server_tls._list_names(settings), *announced]
    uncovered = authority.certify(names, datetime.now(UTC))
    asked: list[None] = []

    def list_announced() -> list[str]:
        asked.append(None)
        return announced

    renewing = asyncio.create_task(
        server_tls._renew_forever(authority, settings, list_announced, uncovered)
    )
    while len(asked) < 3:
        await asyncio.sleep(0.01)
    assert not said
    announced = ["leg.example.org"]
    while not said:
        await asyncio.sleep(0.01)
    assert "leg.example.org" in said[0]
    renewing.cancel()
    await asyncio.gather(renewing, return_exceptions=True)


@pytest.mark.process
@pytest.mark.slow(parts=8)
def test_a_given_certificate_is_served_and_trusted_by_this_user(tmp_path: Path) -> None:
    authority = OwnAuthority(tmp_path / "lab", ["server.local"], datetime.now(UTC))
    authority.certify(["server.local"], datetime.now(UTC))
    pem = tmp_path / "lab" / "tls" / "server.pem"
    words = ("--port=0", f"--tls-cert={pem}", f"--tls-key={pem}", f"--data={tmp_path / 'data'}")
    with closing(start(tmp_path, "serve", *words)) as server:
        url = find_word(server.said("FootTile is at"), "https://").rstrip("/")
        environment = {"XDG_STATE_HOME": str(tmp_path / "state"), "PATH": "/usr/bin:/bin"}
        done = subprocess.run(
            [str(BIN / "foottile"), "invite", "--server", url],
            env=environment,
            capture_output=True,
            text=True,
        )
        assert re.match(r"https://127\.0\.0\.1:\d+/#ticket=", done.stdout), done.stderr
        assert not (tmp_path / "data" / "tls").exists()
        assert not any("have to trust it" in line for line in until(lambda: server.err))
