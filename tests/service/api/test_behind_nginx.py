"""A real nginx in front of a server, with the configuration of docs/security.md."""

from __future__ import annotations

import re
import shutil
import socket
import ssl
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from service.api.settings import LimitSettings
from service.protocol.link import INGEST_PATH
from service.protocol.live import LIVE_PATH
from tests.service.fake_node import NodeOf
from tests.service.running import Running, ServeWith, assert_refused
from tests.waiting import PATIENCE_S, until

ROOT = Path(__file__).resolve().parents[3]
NGINX = shutil.which("nginx", path="/usr/sbin:/usr/bin:/sbin:/bin")
pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(NGINX is None, reason="no nginx; on Debian: sudo apt-get install nginx"),
]
Proxy = Callable[..., int]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        port: int = found.getsockname()[1]
        return port


@pytest.fixture
def nginx(tmp_path: Path) -> Iterator[Proxy]:
    """Start nginx with servers in its configuration, and wait until it answers at a port."""
    started: list[subprocess.Popen[bytes]] = []

    def start(servers: str, port: int) -> int:
        folder = tmp_path / "nginx"
        folder.mkdir()
        temporary = "".join(
            f"{kind}_temp_path {folder / kind};\n"
            for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
        )
        file = folder / "nginx.conf"
        file.write_text(
            f"daemon off; master_process off; pid {folder / 'pid'}; error_log stderr;\n"
            f"events {{}}\nhttp {{ access_log off;\n{temporary}{servers}\n}}\n"
        )
        assert NGINX is not None
        started.append(subprocess.Popen([NGINX, "-e", "stderr", "-p", folder, "-c", file]))
        until(lambda: answers(port))
        return port

    yield start
    for process in started:
        process.terminate()
        process.wait(PATIENCE_S)


def answers(port: int) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
        return True
    return False


def make_configuration(folder: Path, *, listen: int, port: int) -> str:
    """Return the configuration of docs/security.md with this test's ports and certificate."""
    text = (ROOT / "docs" / "security.md").read_text("utf-8")
    (found,) = re.findall(r"```nginx\n(.*?)```", text, re.DOTALL)
    for old, new in (
        ("listen 443 ssl;", f"listen 127.0.0.1:{listen} ssl;"),
        ("http://127.0.0.1:8000", f"http://127.0.0.1:{port}"),
        ("/etc/ssl/foottile.pem", str(folder / "foottile.pem")),
        ("/etc/ssl/foottile.key", str(folder / "foottile.key")),
    ):
        assert found.count(old) == 1, old
        found = found.replace(old, new)
    return str(found)


@pytest.fixture
def tls(tmp_path: Path) -> ssl.SSLContext:
    """A context that trusts the certificate of the proxy."""
    certificate = tmp_path / "foottile.pem"
    words = ("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    named = ("-subj", "/CN=foottile", "-addext", "subjectAltName=IP:127.0.0.1", "-days", "2")
    files = ("-keyout", tmp_path / "foottile.key", "-out", certificate)
    subprocess.run(["openssl", *words, *named, *files], check=True, capture_output=True)
    return ssl.create_default_context(cafile=certificate)


@pytest.fixture
def behind(serve_with: ServeWith) -> Running:
    """A server that trusts the proxy, with the options of the document."""
    return serve_with(bounds=LimitSettings.model_validate({"trusted_proxy": ["127.0.0.1"]}))


@pytest.fixture
def site(behind: Running, nginx: Proxy, tls: ssl.SSLContext, tmp_path: Path) -> str:
    """Address of the documented proxy."""
    port = free_port()
    servers = make_configuration(tmp_path, listen=port, port=behind.port)
    return f"https://127.0.0.1:{nginx(servers, port)}"


def test_a_documented_proxy_passes_logins_recordings_live_data_and_downloads(
    behind: Running, site: str, tls: ssl.SSLContext, node_of: NodeOf
) -> None:
    node = node_of(behind)
    node.connect()
    node.tared()
    ticket = behind.link().partition("#ticket=")[2]
    with httpx.Client(base_url=f"{site}/api/v1", verify=tls, trust_env=False) as client:
        assert_refused(client.delete("/trash"), 401, "token")
        client.headers["Origin"] = site
        answer = client.post("/login", json={"ticket": ticket})
        assert answer.status_code == 200, answer.text
        assert "Secure" in answer.headers["set-cookie"]
        begun = client.post("/sessions", json={"node": "bench", "name": "through the proxy"})
        assert begun.status_code == 201, begun.text
        recording = behind.session(begun.json()["id"])
        node.deliver(50)
        assert client.post(f"{recording.url}/stop").status_code == 200
        node.send(10, now=True)
        recording.sealed()
        downloaded = client.get(f"{recording.url}/data", params={"format": "parquet"})
        assert downloaded.content[:4] == b"PAR1"
        assert_refused(
            client.delete("/trash", headers={"Origin": site.replace("https", "http")}),
            *(403, "another site"),
        )
    address = site.replace("https", "wss")
    with connect(address + LIVE_PATH, ssl=tls, origin=Origin(site), proxy=None) as live:
        assert "hello" in live.recv(timeout=PATIENCE_S)
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(address + INGEST_PATH, ssl=tls, proxy=None),
    ):
        pass
    assert refused.value.response.status_code == 401


def test_a_client_of_a_documented_proxy_cannot_choose_its_address(
    serve_with: ServeWith, nginx: Proxy, tls: ssl.SSLContext, tmp_path: Path
) -> None:
    one = {"max_connections_per_address": 1, "trusted_proxy": ["127.0.0.1"]}
    running, port = serve_with(bounds=LimitSettings.model_validate(one)), free_port()
    nginx(make_configuration(tmp_path, listen=port, port=running.port), port)
    address = f"wss://127.0.0.1:{port}{LIVE_PATH}"
    with connect(address, ssl=tls, proxy=None) as live:
        assert "hello" in live.recv(timeout=PATIENCE_S)
        answer = httpx.get(
            f"https://127.0.0.1:{port}/api/v1/health",
            headers={"X-Forwarded-For": "192.0.2.9"},
            verify=tls,
            trust_env=False,
        )
        assert answer.status_code == 503
