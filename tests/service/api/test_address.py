"""Where a server is found is known before there is one."""

from __future__ import annotations

import socket
import subprocess
import sys

import pytest

from service.api.address import own_names


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
    assert own_names() == names
