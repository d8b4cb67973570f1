"""A server in this process, and a node that does what a test has it do."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from devices.vitals import Vitals
from tests.service.fake_node import FakeNode, Play
from tests.service.recording import Recording
from tests.service.running import Running


class Scripted:
    """A server, and a node that streams whenever the test does not have it do otherwise."""

    def __init__(self, folder: Path, *, token: str | None = None, is_private: bool = False) -> None:
        self.running = Running(folder / "data", token=token, is_private=is_private)
        self.running.start()
        if token is not None:  # what the test itself asks; its pages log in
            self.running.http.headers["Authorization"] = f"Bearer {token}"
        self.node = FakeNode(self.running, token=token)
        self.node.connect()
        self.node.tared()

    @property
    def url(self) -> str:
        return self.running.url

    def ticket(self, role: str = "viewer") -> str:
        """A ticket that logs a browser in, once."""
        answer = self.running.http.post("/tickets", json={"role": role})
        return str(answer.json()["ticket"])

    def recorded(self, name: str) -> Recording:
        """A sealed session."""
        with Play(self.node):
            session = self.node.record(name=name)
            time.sleep(0.2)
            session.stop()
            session.sealed()
        return session

    def pending(self, name: str) -> Recording:
        """A session with a hundred frames that are still with the node."""
        session = self.node.record(name=name)
        self.node.next_t_mono_ns = time.monotonic_ns()
        self.node.frames(100)
        self.node.send(50)
        time.sleep(0.4)
        session.stop()
        self.node.send(10, now=True)
        return session

    def tell(self, *warnings: str, vitals: Vitals | None = None) -> None:
        """Have the server warn of the node's troubles."""

        def change() -> None:
            server: Any = self.running.server
            node = server.nodes.get("bench")
            node.warnings, node.vitals = warnings, vitals
            server.notify_node_changed(node)

        self.running.call(change)

    def close(self) -> None:
        self.node.close()
        self.running.stop()
