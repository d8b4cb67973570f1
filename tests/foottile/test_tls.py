"""A server behind TLS, with a certificate of a laboratory's own CA."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import foottile
from tests.service.fake_node import FakeNode
from tests.service.node.publishing import Publishing, assert_all_arrived
from tests.service.running import Running
from tests.service.strangers import tls_before
from tests.waiting import in_a_loop

HERE = Path(__file__)


@pytest.fixture
def secure(running: Running, tmp_path: Path) -> Iterator[str]:
    with tls_before(running.port, tmp_path) as url:
        yield url


def test_a_certificate_of_an_unknown_ca_is_refused_with_what_to_do(secure: str) -> None:
    with foottile.connect(secure) as server:
        with pytest.raises(
            foottile.ServerUnavailableError, match=r"not trusted.*--ca.*SSL_CERT_FILE"
        ):
            server.nodes()
        with pytest.raises(foottile.ServerUnavailableError, match=r"not trusted.*--ca"):
            next(server.live())


@pytest.mark.parametrize("is_folder", [False, True])
def test_a_ca_that_is_named_is_trusted_for_questions_and_streams(
    secure: str, tmp_path: Path, is_folder: bool
) -> None:
    ca = tmp_path / "ca.pem"
    if is_folder:
        folder = tmp_path / "certificates"
        folder.mkdir()
        ca.rename(folder / "ca.pem")
        words = ("openssl", "x509", "-hash", "-noout", "-in", str(folder / "ca.pem"))
        name = subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
        (folder / f"{name}.0").symlink_to("ca.pem")
        ca = folder
    with foottile.connect(secure, ca=ca) as server:
        assert server.nodes() == []
        with pytest.raises(foottile.InvalidRequestError, match="nobody"):
            next(server.live("nobody"))


@in_a_loop
async def test_asyncio_trusts_it_too(secure: str, tmp_path: Path) -> None:
    async with foottile.connect_async(secure, ca=tmp_path / "ca.pem") as server:
        assert await server.nodes() == []
        with pytest.raises(foottile.InvalidRequestError, match="nobody"):
            await anext(server.live("nobody"))
    async with foottile.connect_async(secure) as server:
        with pytest.raises(foottile.ServerUnavailableError, match="not trusted"):
            await anext(server.live("nobody"))


def test_a_ca_of_the_environment_is_trusted(
    secure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "ca.pem"))
    with foottile.connect(secure) as server:
        assert server.nodes() == []


@in_a_loop
async def test_a_node_trusts_a_ca_that_is_named_and_says_when_it_does_not(
    secure: str, running: Running, node: FakeNode, tmp_path: Path
) -> None:
    async with Publishing(node, secure) as publishing:
        await publishing.until(lambda: publishing.reports)
    assert "not trusted" in publishing.reports[0]
    assert "trying again" in publishing.reports[0]
    async with Publishing(node, secure, ca=tmp_path / "ca.pem") as publishing:
        publishing.take(50)
        await publishing.emptied()
    assert_all_arrived(running, node)


@pytest.mark.parametrize("content", [None, b"", b"no certificate", b"\xff\xfe"])
def test_what_is_no_ca_is_said(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "ca.pem"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(foottile.InvalidRequestError, match=r"ca\.pem"):
        foottile.connect("https://127.0.0.1:1", ca=path)


def test_plain_http_and_tls_are_not_taken_for_each_other(running: Running, secure: str) -> None:
    with (
        foottile.connect(running.url.replace("http:", "https:")) as server,
        pytest.raises(foottile.ServerUnavailableError, match="use http://"),
    ):
        server.nodes()
    with (
        foottile.connect(secure.replace("https:", "http:")) as server,
        pytest.raises(foottile.ServerUnavailableError),
    ):
        server.nodes()
    with pytest.raises(foottile.InvalidRequestError, match="https"):
        foottile.connect(running.url, ca=HERE)
