"""Where a server is found is known before there is one."""

from __future__ import annotations

import socket
import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import LinkError, UsageError
from service.api.address import (
    InterfaceAddress,
    list_own_names,
    list_urls,
    open_listening_socket,
    parse_advertised_url,
    sort_addresses,
)


def test_where_a_server_will_be_is_known_without_importing_what_it_is_made_of() -> None:
    # `foottile demo` starts its node by it, which looks for its tiles while the server is prepared.
    code = (
        "import sys, service.api.address, service.cli.commands.demo\n"
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
        ("", ()),
        ("127", ()),
        ("a b", ()),
        ("evil/..", ()),
        ("*", ()),
        ("x" * 65, ()),
    ],
)
def test_a_machine_goes_by_its_own_name_and_no_other(
    name: str, names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: name)
    assert list_own_names() == names


def addresses(*listed: str) -> list[str]:
    """Addresses in their order; each is listed as `interface address [no-carrier] [first]`."""
    found = [
        InterfaceAddress(
            line.split()[0],
            line.split()[1],
            has_carrier="no-carrier" not in line,
            is_first_host="first" in line,
        )
        for line in listed
    ]
    return [each.address for each in sort_addresses(found)]


def test_the_address_that_a_phone_reaches_comes_first() -> None:
    expected = ["192.168.4.1", "10.1.2.3", "fd00::2", "203.0.113.5", "2001:db8::5"]
    expected += ["169.254.7.7", "fe80::1%eth0", "192.168.7.1", "172.18.0.1", "10.8.0.2"]
    listed = [
        *(
            "br-0123456789ab 172.18.0.1 first",
            "docker0 172.17.0.1 first no-carrier",
            "tun0 10.8.0.2",
        ),
        *("lo 127.0.0.1", "lo ::1", "eth0 203.0.113.5", "eth0 2001:db8::5", "eth0 fe80::1%eth0"),
        *("eth1 169.254.7.7", "eth2 192.168.7.1 first no-carrier", "eth3 10.1.2.3", "eth3 fd00::2"),
        "wlan0 192.168.4.1 first",
    ]
    for order in (listed, listed[::-1], sorted(listed)):
        assert addresses(*order) == expected


@given(st.permutations(["eth0 10.1.2.3", "ap0 10.42.0.1 first", "docker0 172.17.0.1 first"]))
def test_no_bridge_comes_before_a_network(listed: list[str]) -> None:
    assert addresses(*listed) == ["10.42.0.1", "10.1.2.3", "172.17.0.1"]


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
def test_an_address_to_show_is_a_host_a_port_too_or_all_of_it(advertised: str, url: str) -> None:
    assert parse_advertised_url(advertised, 8000) == url


@pytest.mark.parametrize(
    "wrong", ["", " ", "a b", "ftp://x", "x:y", "x@y", "lab/path", "[fd00", "x:99999", "http://"]
)
def test_what_is_no_address_to_show_is_refused(wrong: str) -> None:
    with pytest.raises(UsageError, match="--advertise"):
        parse_advertised_url(wrong, 8000)


def test_localhost_is_shown_as_the_address_that_is_listened_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its name leads to ::1 first on many machines, where another program may listen."""
    real = socket.getaddrinfo

    def both(host: str, port: int, **options: Any) -> list[Any]:
        return [*real("::1", port, **options), *real("127.0.0.1", port, **options)]

    monkeypatch.setattr(socket, "getaddrinfo", both)
    with open_listening_socket("localhost", 0) as listening:
        port = listening.getsockname()[1]
        assert list_urls(listening, "localhost") == [f"http://127.0.0.1:{port}"]


def test_everywhere_is_ipv4_too() -> None:
    with open_listening_socket("::", 0) as listening:
        port = listening.getsockname()[1]
        assert list_urls(listening, "::")[-1] == f"http://127.0.0.1:{port}"
        for host in ("127.0.0.1", "::1"):
            socket.create_connection((host, port), timeout=5.0).close()


@pytest.mark.parametrize(
    ("host", "word"), [("192.0.2.77", "--host"), ("fe80::1", "zone"), ("no-host.invalid", "--host")]
)
def test_an_address_that_is_not_this_machines_is_said(host: str, word: str) -> None:
    with pytest.raises(LinkError, match=word):
        open_listening_socket(host, 0)
