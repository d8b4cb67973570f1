"""Networks of their own for a test: a namespace with interfaces, and what runs in it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from tests.waiting import until

ROOT = Path(__file__).resolve().parents[2]


def can_make_networks() -> bool:
    words = ("unshare", "--net", "ip", "link", "add", "near", "type", "veth", "peer", "name", "far")
    try:
        return subprocess.run(words, capture_output=True).returncode == 0
    except FileNotFoundError:
        return False


needs_networks = pytest.mark.skipif(
    not can_make_networks(), reason="no network namespaces here: they need root and iproute2"
)


class Machine:
    """A namespace that stands for a machine; its interface is `cable`."""

    def __init__(self) -> None:
        self._holder = subprocess.Popen(["unshare", "--net", "sleep", "1000"])
        own = os.readlink("/proc/self/ns/net")
        until(lambda: os.readlink(f"/proc/{self.pid}/ns/net") != own)
        self.run("ip link set lo up")

    @property
    def pid(self) -> int:
        return self._holder.pid

    @property
    def before(self) -> tuple[str, ...]:
        """Words before a command that runs on this machine."""
        return ("nsenter", f"--net=/proc/{self.pid}/ns/net")

    def run(self, lines: str) -> None:
        subprocess.run([*self.before, "sh", "-ec", lines], check=True)

    def close(self) -> None:
        self._holder.kill()
        self._holder.wait()


@contextmanager
def connected_machines() -> Iterator[tuple[Machine, Machine]]:
    """Two machines with a cable between, whose interfaces are still down."""
    with closing(Machine()) as one, closing(Machine()) as other:
        words = f"ip link add cable netns {one.pid} type veth peer name cable netns {other.pid}"
        subprocess.run(words.split(), check=True)
        yield one, other


def run_in_network(interfaces: dict[str, str], code: str, **environment: str) -> str:
    """Run Python code in a namespace; what it prints.

    Args:
        interfaces: by name the address of each, with its prefix; empty: only its link-local one.
        code: the program.
        environment: further variables.
    """
    lines = ["set -e", "ip link set lo up"]
    for number, (name, address) in enumerate(interfaces.items()):
        lines += [
            f"ip link add {name} type veth peer name far{number}",
            f"ip link set far{number} addrgenmode none up",
            f"echo 0 > /proc/sys/net/ipv6/conf/{name}/accept_dad",
            f"ip link set {name} up",
        ]
        lines += [f"ip addr add {address} dev {name}"] if address else []
    lines.append(f'exec {sys.executable} -c "$CODE"')
    done = subprocess.run(
        ["unshare", "--net", "sh", "-c", "\n".join(lines)],
        env={**os.environ, "PYTHONPATH": str(ROOT), "CODE": code, **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
