"""Servers and nodes find each other in a network, and a node chooses its server."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import LinkError
from foottile.local_server import LocalServer, publish_local_server
from service import discovery
from service.cli.commands.node import _ask_for_server
from service.discovery import Discovery, FoundService
from service.node.server_finder import LOCAL_URL, ServerFinder, list_candidates
from storage.permissions import SECRETS_NAME, write_secrets
from tests.service.networks import Machine, connected_machines, needs_networks, run_in_network
from tests.service.process import BIN, Process
from tests.waiting import in_a_loop, until

IDS = ("a", "b", "c", "d")


def server(server_id: str, address: str = "192.168.4.1", **texts: str) -> FoundService:
    texts |= {"id": server_id, "machine": "laptop"}
    return FoundService("foottile", "foottile.local", 8000, (address,), texts)


_SERVERS = st.lists(st.sampled_from(IDS).map(server), unique_by=lambda each: each.server_id)
_KNOWN = st.sets(st.sampled_from(IDS))


@given(_SERVERS, _KNOWN)
def test_a_server_that_shares_a_secret_wins_over_all_strangers(
    found: list[FoundService], known: set[str]
) -> None:
    candidates = list_candidates(found, known)
    ids = {each.server_id for each in found}
    assert {each.server_id for each in candidates} == (ids & known or ids)


@given(_SERVERS, _KNOWN, st.sampled_from(IDS))
def test_a_chosen_server_has_no_rival(
    found: list[FoundService], known: set[str], chosen: str
) -> None:
    candidates = list_candidates(found, known, chosen_id=chosen)
    assert candidates == [each for each in found if each.server_id == chosen]


@given(_SERVERS, _KNOWN, st.sampled_from(("", *IDS)))
def test_with_a_ca_a_server_without_tls_is_none(
    found: list[FoundService], known: set[str], chosen: str
) -> None:
    secure = [server(name, tls="1") for name in ("c", "d")]
    candidates = list_candidates([*found, *secure], known, chosen_id=chosen, needs_tls=True)
    assert candidates == list_candidates(secure, known, chosen_id=chosen)


def test_a_server_that_moved_counts_once_at_its_newest_address() -> None:
    old, new = server("a", "192.168.4.1"), server("a", "192.168.4.7")
    assert list_candidates([old, new], ()) == [new]


def test_an_address_with_a_zone_is_written_as_in_a_url() -> None:
    assert server("a", "fe80::1%eth0", tls="1").urls == ["https://[fe80::1%25eth0]:8000"]


class Network(Discovery):
    """A discovery that finds what a test says."""

    def __init__(self, *found: FoundService) -> None:
        super().__init__(report=print)
        self.found = list(found)

    async def list_found(self, kind: str) -> list[FoundService]:
        return self.found


@pytest.fixture(autouse=True)
def _no_local_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@in_a_loop
async def test_a_node_stays_with_the_server_that_accepted_it() -> None:
    network = Network()
    finder = ServerFinder(network, pytest.fail)
    assert await finder.find(()) == LOCAL_URL
    network.found = [server("a", "192.168.4.1")]
    assert await finder.find(()) == "http://192.168.4.1:8000"
    network.found = [server("b", "192.168.4.2"), server("a", "192.168.4.3")]
    with pytest.raises(LinkError, match=r"2 servers.*192\.168\.4\.2.*--server"):
        await finder.find(())
    assert await finder.find(("b", "a")) == "http://192.168.4.3:8000"
    network.found = [server("b", "192.168.4.2")]
    assert await finder.find(("b", "a")) == "http://192.168.4.3:8000"


@in_a_loop
async def test_after_a_minute_without_its_server_a_node_names_the_others_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s, said = 1000.0, list[str]()
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    network = Network(server("a", "192.168.4.1"))
    finder = ServerFinder(network, said.append)
    await finder.find(("a",))
    network.found = [server("b", "192.168.4.2")]
    now_s += 3600.0  # it was connected
    for _ in range(5):
        assert await finder.find(("a",)) == "http://192.168.4.1:8000"
        now_s += 11.0
    assert not said
    for _ in range(5):
        await finder.find(("a",))
        now_s += 11.0
    (line,) = said
    assert "192.168.4.2" in line
    assert "restart the node" in line
    assert "--server" in line


@in_a_loop
async def test_a_server_of_this_user_on_this_machine_comes_first() -> None:
    finder = ServerFinder(Network(server("a")), pytest.fail)
    with publish_local_server(LocalServer(LOCAL_URL, "a-token-of-this-test")):
        assert await finder.find(("a",)) == LOCAL_URL
    assert await finder.find(("a",)) == "http://192.168.4.1:8000"


@in_a_loop
async def test_with_a_ca_nothing_else_than_a_server_with_tls_is_asked(tmp_path: Path) -> None:
    finder = ServerFinder(Network(server("a")), pytest.fail, ca_path=tmp_path / "ca.crt")
    with pytest.raises(LinkError, match="not found"):
        await finder.find(("a",))


@in_a_loop
async def test_without_the_library_the_extra_is_named_and_nothing_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "zeroconf", None)
    monkeypatch.setitem(sys.modules, "zeroconf.asyncio", None)
    reports: list[str] = []
    async with Discovery((discovery.SERVERS,), report=reports.append) as missing:
        while not reports:
            await asyncio.sleep(0.01)
        assert not missing.is_installed
        assert await ServerFinder(missing, pytest.fail).find(()) == LOCAL_URL
    assert "foottile[discovery]" in reports[0]


@needs_networks
def test_a_machine_without_a_network_finds_nothing_and_says_nothing() -> None:
    code = (
        "import asyncio\nfrom service.discovery import SERVERS, search_once\n"
        "print(asyncio.run(search_once((SERVERS,), 0.3, print)))"
    )
    assert run_in_network({}, code) == "{'_foottile._tcp.local.': []}\n"


@needs_networks
def test_a_refused_multicast_is_a_remark() -> None:
    code = (
        "import asyncio, socket\nfrom service.discovery import SERVERS, search_once\n"
        "def refuse(*_):\n    raise PermissionError('not here')\n"
        "socket.socket.bind = refuse\n"
        "print(asyncio.run(search_once((SERVERS,), 0.5, print)))"
    )
    lines = run_in_network({"near": "10.77.0.1/24"}, code).splitlines()
    assert lines == [
        "servers and nodes are not found by themselves: PermissionError('not here')",
        "{'_foottile._tcp.local.': []}",
    ]


_STRANGERS = r"""
import asyncio
from zeroconf import DNSOutgoing, DNSPointer
from zeroconf.asyncio import AsyncServiceInfo, AsyncZeroconf
from service.discovery import SERVERS, Discovery

def announce(host, texts, *addresses):
    return AsyncServiceInfo(
        SERVERS, f"{host}.{SERVERS}", port=8000, properties=texts, server=f"{host}.local.",
        parsed_addresses=[*addresses],
    )

async def main():
    near = ["10.77.0.1"]
    async with Discovery((SERVERS,), report=print) as discovery, AsyncZeroconf(near) as other:
        await asyncio.sleep(0.3)
        out = DNSOutgoing(0x8400)
        long = f"{30 * 'ü'}.{20 * 'a'}.{SERVERS}"
        for name in (f"a\x07b.{SERVERS}", "x._FOOTTILE._tcp.local.", long):
            out.add_answer_at_time(DNSPointer(SERVERS, 12, 1, 4500, name), 0)
        other.zeroconf.async_send(out)
        for each in (
            announce("screen", {"machine": "\x1b[2J"}, "10.77.0.2"),
            announce("right", {"machine": "\u202egnp"}, "10.77.0.2"),
            announce("many", {"id": "m"}, *(f"10.77.0.{n}" for n in range(2, 60))),
            announce("honest", {"id": "a"}, "10.77.0.2"),
        ):
            await other.async_register_service(each)
        for _ in range(50):
            found = [each.name for each in await discovery.list_found(SERVERS)]
            if "honest" in found:
                return print(found)
            await asyncio.sleep(0.1)

asyncio.run(main())
"""


@needs_networks
def test_a_service_that_no_server_or_node_announces_is_left_out() -> None:
    assert run_in_network({"near": "10.77.0.1/24"}, _STRANGERS) == "['honest']\n"


@in_a_loop
async def test_a_failure_finds_nothing_and_is_a_remark() -> None:
    reports: list[str] = []
    network = Discovery((discovery.SERVERS,), report=reports.append)
    network._open = object()  # type: ignore[assignment]  # a bug, whatever it be
    assert await network.list_found(discovery.SERVERS) == []
    assert len(reports) == 1


@pytest.mark.parametrize("known", [(), ("b",)])
def test_a_person_chooses_on_a_terminal_unless_a_server_is_known(
    known: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def search(*_: object) -> dict[str, list[FoundService]]:
        return {discovery.SERVERS: [server("a"), server("b")]}

    write_secrets(tmp_path / SECRETS_NAME, dict.fromkeys(known, "0" * 64))
    monkeypatch.setattr(discovery, "search_once", search)
    monkeypatch.setattr(typer, "prompt", lambda *_, **__: 1)
    assert _ask_for_server(tmp_path, None) == ""
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    assert _ask_for_server(tmp_path, None) == ("" if known else "a")


def find(machine: Machine) -> dict[str, Any]:
    words = [*machine.before, str(BIN / "foottile"), "find", "--json"]
    done = subprocess.run(words, capture_output=True, text=True)
    content: dict[str, Any] = json.loads(done.stdout)
    return content


@needs_networks
@pytest.mark.process
@pytest.mark.slow(parts=8)
def test_a_node_that_starts_first_finds_its_server_once_a_cable_and_a_server_are_there(
    tmp_path: Path,
) -> None:
    with ExitStack() as stack:
        robot, laptop = stack.enter_context(connected_machines())

        def start(machine: Machine, name: str, *words: object) -> Process:
            environment = {"XDG_STATE_HOME": str(tmp_path / name / "state")}
            process = Process(*words, folder=tmp_path / name, before=machine.before, **environment)
            return stack.enter_context(closing(process))

        def serve(name: str, port: int) -> Process:
            words = ("serve", "--host=0.0.0.0", "--port", port, "--data", tmp_path / name)
            return start(laptop, f"{name}-run", *words)

        node = start(robot, "left", "node", "--scene", "rolling", "--name", "left")
        node.said("frames/s")
        robot.run("ip link set cable up; ip addr add 10.77.0.1/24 dev cable")
        first = serve("first", 8000)
        first.said("FootTile is at")
        laptop.run("ip link set cable up; ip addr add 10.77.0.2/24 dev cable")
        first.said("it is also at http://foottile.local:8000")
        node.said("connected to ws://10.77.0.2:8000")

        second = serve("second", 8001)
        second.said("it is also at http://foottile-2.local:8001")
        found = until(lambda: len((seen := find(robot))["servers"]) == 2 and seen)
        assert found
        assert {each["urls"][0] for each in found["servers"]} == {
            "http://10.77.0.2:8000",
            "http://10.77.0.2:8001",
        }
        assert [each["name"] for each in found["nodes"]] == ["left"]

        # A node that knows neither connects to none; one that knows the first stays with it.
        stranger = start(robot, "right", "node", "--scene", "rolling", "--name", "right")
        assert "--server" in stranger.said("2 servers announce themselves")
        first.process.kill()  # it says no goodbye
        first.process.wait()
        serve("first", 8002).said("it is also at http://foottile.local:8002")
        node.said("connected to ws://10.77.0.2:8002")
        assert not any("8001" in line for line in node.err)
