"""A data folder of a server with all there is in it; copies and digests of such folders."""

from __future__ import annotations

import hashlib
import shutil
import time
from dataclasses import fields
from pathlib import Path
from unittest.mock import patch

from devices.frames import FrameBatch
from tests.service.fake_node import FakeNode
from tests.service.running import Running
from tests.waiting import until

NODES = ("left", "right")


def data_folder(folder: Path) -> Path:
    """A data folder of a server with all there is: two nodes, tares, marks, clocks, sessions.

    Of each node one session is sealed, and one of the left's is pending.
    """
    with (
        patch("service.server.server.TICK_S", 0.02),
        patch("service.server.recorder.MAX_DELAY_S", 1e9),  # its frames are long ago
        patch("service.api.routes.recordings.sessions.SEAL_TIMEOUT_S", 0.02),
    ):
        _record(folder)
    (folder / "token").write_text("a-token-of-an-earlier-start\n")
    return folder


def _record(folder: Path) -> None:
    running = Running(folder)
    running.start()
    nodes = [FakeNode(running, name) for name in NODES]
    try:
        for node in nodes:
            node.connect()
            node.tared()
            node.next_t_mono_ns += 11_000_000_000
            node.deliver(300, 2.0, alive=True)
            assert running.http.post(f"/nodes/{node.name}/tare", json={}).status_code == 201
            session = node.record(name="walk", tags=["a"])
            node.deliver(100, 5.0)
            event = {"label": "step"}
            assert running.http.post(f"{session.url}/markers", json=event).status_code == 201
            node.finish(session)
            if node is nodes[0]:
                pending = node.record(name="pending")
                node.deliver(100, 7.0)
                node.leave()
                newest_ns = node.next_t_mono_ns
                until(lambda newest_ns=newest_ns: time.monotonic_ns() > newest_ns)  # type: ignore[misc]  # bound here
                pending.stop()
                assert pending.now()["state"] == "pending"
    finally:
        for node in nodes:
            node.close()
        running.stop()


def digest(batch: FrameBatch) -> str:
    columns = [getattr(batch, column.name) for column in fields(batch)]
    return hashlib.sha256(b"".join(column.tobytes() for column in columns)).hexdigest()


def sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "no file"


def copied(data: Path, to: Path) -> Path:
    shutil.rmtree(to, ignore_errors=True)
    return shutil.copytree(data, to)
