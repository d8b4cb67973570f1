"""Addresses of a server: its names, its URLs in the networks of the field, and its token."""

from __future__ import annotations

import json
import socket
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import LinkError, UsageError
from service.api.address import (
    InterfaceAddress,
    list_own_names,
    list_urls,
    load_or_create_token,
    open_listening_socket,
    parse_advertised_url,
    sort_addresses,
)
from tests.service.networks import needs_networks, run_in_network


def test_an_address_needs_no_heavy_import() -> None:
    # `foottile demo` starts its node with it, which looks for tiles while the server is prepared.
    code = (
        "import sys, service.api.address, service.cli.commands.serve\n"
        "print([name for name in ('fastapi', 'uvicorn', 'numba') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(
    ("name", "names"),
    [
        ("laptop", ("laptop", "laptop.local")),
        ("Laptop", ("laptop", "laptop.local")),
        ("laptop.lab.example.org", ("laptop.lab.example.org", "laptop", "laptop.local")),
        ("laptop.local", ("laptop.local", "laptop")),
        *[(wrong, ()) for wrong in ("", "127", "a b", "evil/..", "*", "x" * 65)],
    ],
)
def test_a_machine_has_its_own_names_only(
    name: str, names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: name)
    assert list_own_names() == names


def sort_lines(*lines: str) -> list[str]:
    """Sort the addresses of lines `interface address [no-carrier] [first]`."""
    found = [
        InterfaceAddress(name, address, "no-carrier" not in notes, "first" in notes)
        for name, address, *notes in map(str.split, lines)
    ]
    return [each.address for each in sort_addresses(found)]


LINES = [
    *("br-0123456789ab 172.18.0.1 first", "docker0 172.17.0.1 first no-carrier"),
    *("tun0 10.8.0.2", "lo 127.0.0.1", "lo ::1", "eth0 203.0.113.5", "eth0 2001:db8::5"),
    *("eth0 fe80::1%eth0", "eth1 169.254.7.7", "eth2 192.168.7.1 first no-carrier"),
    *("eth3 10.1.2.3", "eth3 fd00::2", "wlan0 192.168.4.1 first"),
]


@given(st.permutations(LINES))
def test_the_address_for_a_phone_comes_first(lines: list[str]) -> None:
    assert sort_lines(*lines) == [
        *("192.168.4.1", "10.1.2.3", "fd00::2", "203.0.113.5", "2001:db8::5"),
        *("169.254.7.7", "fe80::1%eth0", "192.168.7.1", "172.18.0.1", "10.8.0.2"),
    ]


def test_a_container_bridge_comes_behind_networks() -> None:
    lines = ("docker0 172.17.0.1 first", "eth0 10.1.2.3", "ap0 10.42.0.1 first")
    assert sort_lines(*lines) == ["10.42.0.1", "10.1.2.3", "172.17.0.1"]


@pytest.mark.parametrize(
    ("advertised", "url"),
    [
        ("laptop.local", "http://laptop.local:8000"),
        ("192.168.4.1", "http://192.168.4.1:8000"),
        ("192.168.4.1:80", "http://192.168.4.1:80"),
        ("fd00::2", "http://[fd00::2]:8000"),
        ("[fd00::2]", "http://[fd00::2]:8000"),
        ("[fd00::2]:81", "http://[fd00::2]:81"),
        ("fe80::1%eth0", "http://[fe80::1%25eth0]:8000"),
        ("https://lab.example/", "https://lab.example"),
        ("https://lab.example:8443", "https://lab.example:8443"),
    ],
)
def test_an_advertised_address_is_a_host_with_or_without_port_or_a_url(
    advertised: str, url: str
) -> None:
    assert parse_advertised_url(advertised, 8000) == url


@pytest.mark.parametrize(
    "wrong", ["", " ", "a b", "ftp://x", "x:y", "x@y", "lab/path", "[fd00", "x:99999", "http://"]
)
def test_a_wrong_advertised_address_is_refused(wrong: str) -> None:
    with pytest.raises(UsageError, match="--advertise"):
        parse_advertised_url(wrong, 8000)


def test_localhost_is_shown_as_its_address(monkeypatch: pytest.MonkeyPatch) -> None:
    """On many machines its name leads to ::1 first, where another program may listen."""
    find = socket.getaddrinfo

    def find_both(host: str, port: int, **options: Any) -> list[Any]:
        return [*find("::1", port, **options), *find("127.0.0.1", port, **options)]

    monkeypatch.setattr(socket, "getaddrinfo", find_both)
    with open_listening_socket("localhost", 0) as listening:
        port = listening.getsockname()[1]
        assert list_urls(listening, "localhost") == [f"http://127.0.0.1:{port}"]


def test_a_socket_on_all_addresses_accepts_ipv4_and_ipv6() -> None:
    with open_listening_socket("::", 0) as listening:
        port = listening.getsockname()[1]
        assert list_urls(listening, "::")[-1] == f"http://127.0.0.1:{port}"
        for host in ("127.0.0.1", "::1"):
            socket.create_connection((host, port), timeout=5.0).close()


@pytest.mark.parametrize(
    ("host", "word"), [("192.0.2.77", "--host"), ("fe80::1", "zone"), ("no-host.invalid", "--host")]
)
def test_an_address_of_another_machine_is_refused(host: str, word: str) -> None:
    with pytest.raises(LinkError, match=word):
        open_listening_socket(host, 0)


def test_a_token_is_created_once_for_its_owner_and_an_empty_one_replaced(tmp_path: Path) -> None:
    data = tmp_path / "data"
    token = load_or_create_token(None, data)
    assert len(token) >= 20
    assert stat.S_IMODE((data / "token").stat().st_mode) == 0o600
    assert load_or_create_token(None, data) == token
    assert load_or_create_token("given", data) == "given"
    # FOOTTILE_TOKEN= must not open the server; a power cut leaves a file created and not written.
    (tmp_path / "token").touch(mode=0o600)
    assert load_or_create_token(None, tmp_path)
    assert load_or_create_token("", tmp_path / "other")


# --- in namespaces of networks --------------------------------------------------------------------

URLS = """
import json
from service.api.address import open_listening_socket, list_urls
host, advertised = %r, %r
with open_listening_socket(host, 8000) as listening:
    print(json.dumps(list_urls(listening, host, advertised)))
"""


def list_urls_in(
    interfaces: dict[str, str],
    host: str = "0.0.0.0",  # noqa: S104  # in a namespace
    advertised: str | None = None,
) -> list[str]:
    urls: list[str] = json.loads(run_in_network(interfaces, URLS % (host, advertised)))
    return [url.removeprefix("http://").removesuffix(":8000") for url in urls]


@needs_networks
@pytest.mark.parametrize(
    ("interfaces", "expected"),
    [
        ({"wlan0": "192.168.4.1/24"}, ["192.168.4.1"]),
        ({"eth0": "169.254.10.20/16"}, ["169.254.10.20"]),
        (
            {"docker0": "172.17.0.1/16", "eth0": "203.0.113.5/24", "ap0": "10.42.0.1/24"},
            ["10.42.0.1", "203.0.113.5", "172.17.0.1"],
        ),
        ({}, []),
    ],
    ids=[
        "a hotspot alone",
        "a cable between two machines",
        "hotspot, Internet, containers",
        "none",
    ],
)
def test_every_address_is_shown(interfaces: dict[str, str], expected: list[str]) -> None:
    assert list_urls_in(interfaces) == [*expected, "127.0.0.1"]


@needs_networks
def test_a_cable_without_ipv4_has_an_address_with_its_zone() -> None:
    first, *others = list_urls_in({"eth7": ""}, "::")
    assert first.startswith("[fe80::")
    assert first.endswith("%25eth7]")
    assert others == ["127.0.0.1"]


@needs_networks
def test_an_advertised_address_replaces_the_others() -> None:
    urls = list_urls_in({"eth0": "172.17.0.2/16"}, advertised="robot.local")
    assert urls == ["robot.local", "127.0.0.1"]


SERVED = """
import asyncio, os, subprocess, sys
import foottile
from service.node.server_connection import connect_tcp, make_ingest_url

os.environ.pop("FOOTTILE_TOKEN", None)
words = [sys.executable, "-c", "from service.cli.main import main; main()"]
serve = subprocess.Popen(
    [*words, "serve", "--host", "::", "--port", "8000", "--data", os.environ["DATA"]],
    stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
)
try:
    urls = [serve.stdout.readline().split()[-1].rstrip("/") for _ in range(3)]
    print(*urls)
    token = open(os.environ["DATA"] + "/token").read()
    for url in urls:
        with foottile.connect(url, token) as server:
            # Its name by mDNS is one more, once it is announced.
            invited = [each for each in server.create_invite()["urls"] if ".local:" not in each]
            print(server.nodes(), len(invited))
            try:
                next(server.live("nobody"))
            except foottile.InvalidRequestError as error:
                print("no node" if "nobody" in str(error) else error)
        asyncio.run(connect_tcp(make_ingest_url(url))).close()
    ticket = subprocess.run(
        [*words, "invite", "--data", os.environ["DATA"]], capture_output=True, text=True
    )
    print(ticket.stdout.partition("#")[0])
finally:
    serve.terminate()
    print(serve.communicate(timeout=60.0)[1])
"""


@pytest.mark.slow(parts=8)
@needs_networks
@pytest.mark.process
def test_client_and_node_reach_every_address(tmp_path: Path) -> None:
    lines = run_in_network(
        {"wlan0": "192.168.4.1/24"}, SERVED, DATA=str(tmp_path / "data")
    ).splitlines()
    hotspot, cable, own = lines[0].split()
    assert hotspot == "http://192.168.4.1:8000"
    assert cable.startswith("http://[fe80::")
    assert cable.endswith("%25wlan0]:8000")
    assert own == "http://127.0.0.1:8000"
    assert lines[1:7] == ["[] 3", "no node"] * 3
    assert lines[7] == "http://192.168.4.1:8000/"  # of a ticket
