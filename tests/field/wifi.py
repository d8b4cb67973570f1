"""Wi-Fi of a test: machines in namespaces of their own on a switch; each may lose it."""

from __future__ import annotations

import subprocess
from contextlib import ExitStack, closing
from pathlib import Path

from tests.service.networks import Machine


class Wifi:
    """Switch of a network 10.77.0.0/24.

    Args:
        stack: ends all machines.
    """

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._switch = stack.enter_context(closing(Machine()))
        self._switch.run("ip link add wifi type bridge; ip link set wifi up")

    def add_machine(self, number: int) -> Machine:
        """Return a machine with the address 10.77.0.`number`."""
        machine = self._stack.enter_context(closing(Machine()))
        words = f"ip link add wlan netns {machine.pid} type veth"
        words += f" peer name port{number} netns {self._switch.pid}"
        subprocess.run(words.split(), check=True)
        self._switch.run(f"ip link set port{number} master wifi up")
        machine.run(f"ip addr add 10.77.0.{number}/24 dev wlan; ip link set wlan up")
        return machine

    def lose(self, number: int) -> None:
        """Take the network from a machine."""
        self._switch.run(f"ip link set port{number} down")

    def restore(self, number: int) -> None:
        """Give it back."""
        self._switch.run(f"ip link set port{number} up")


def make_program(path: Path, machine: Machine, program: str) -> Path:
    """Write a program at `path` that runs another one on a machine."""
    path.write_text(f'#!/bin/sh\nexec {" ".join(machine.before)} {program} "$@"\n')
    path.chmod(0o755)
    return path
