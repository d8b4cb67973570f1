"""Where a server says it is, in the networks of the field: each is a namespace of its own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.service.networks import needs_networks, run_in_network

pytestmark = needs_networks

URLS = """
import json
from service.api.address import open_listening_socket, list_urls
host, advertised = %r, %r
with open_listening_socket(host, 8000) as listening:
    print(json.dumps(list_urls(listening, host, advertised)))
"""


def urls_in(
    interfaces: dict[str, str],
    host: str = "0.0.0.0",  # noqa: S104  # in a namespace
    advertised: str | None = None,
) -> list[str]:
    urls: list[str] = json.loads(run_in_network(interfaces, URLS % (host, advertised)))
    return [url.removeprefix("http://").removesuffix(":8000") for url in urls]


@pytest.mark.parametrize(
    ("interfaces", "expected"),
    [
        # A hotspot without a way to anywhere.
        ({"wlan0": "192.168.4.1/24"}, ["192.168.4.1"]),
        # A cable between two machines, with no server that gives addresses.
        ({"eth0": "169.254.10.20/16"}, ["169.254.10.20"]),
        # A hotspot beside a way to the Internet, and containers.
        (
            {"docker0": "172.17.0.1/16", "eth0": "203.0.113.5/24", "ap0": "10.42.0.1/24"},
            ["10.42.0.1", "203.0.113.5", "172.17.0.1"],
        ),
        ({}, []),
    ],
)
def test_every_address_is_shown(interfaces: dict[str, str], expected: list[str]) -> None:
    assert urls_in(interfaces) == [*expected, "127.0.0.1"]


def test_a_cable_without_any_ipv4_address_has_one_with_its_zone() -> None:
    first, *others = urls_in({"eth7": ""}, "::")
    assert first.startswith("[fe80::")
    assert first.endswith("%25eth7]")
    assert others == ["127.0.0.1"]


def test_what_is_advertised_is_shown_instead() -> None:
    assert urls_in({"eth0": "172.17.0.2/16"}, advertised="robot.local") == [
        *("robot.local", "127.0.0.1")
    ]


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
            print(server.nodes(), len(server.create_invite()["urls"]))
            try:
                next(server.live("nobody"))
            except foottile.UsageError as error:
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


@pytest.mark.process
def test_every_address_that_is_shown_is_answered_by_client_and_node(tmp_path: Path) -> None:
    said = run_in_network(
        {"wlan0": "192.168.4.1/24"}, SERVED, DATA=str(tmp_path / "data")
    ).splitlines()
    hotspot, cable, own = said[0].split()
    assert hotspot == "http://192.168.4.1:8000"
    assert cable.startswith("http://[fe80::")
    assert cable.endswith("%25wlan0]:8000")
    assert own == "http://127.0.0.1:8000"
    assert said[1:7] == ["[] 3", "no node"] * 3
    assert said[7] == "http://192.168.4.1:8000/"  # of a ticket
