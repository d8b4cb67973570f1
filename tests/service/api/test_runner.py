"""First start: while another process compiles, pressures are shown and no frame is lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from websockets.sync.client import connect

import service.api.app
from service.estimation.compilation import is_compiling
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import ServeWith, receive_live
from tests.waiting import PATIENCE_S, until


@pytest.fixture
def compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file; another process "compiles" until it exists."""
    path = tmp_path / "compiled"
    wait = f"while not p.Path({str(path)!r}).exists(): t.sleep(0.02)"
    monkeypatch.setattr(service.api.app, "load_cached_code", lambda: False)
    monkeypatch.setattr(service.api.app, "_COMPILE_CODE", f"import pathlib as p, time as t\n{wait}")
    return path


def receive_frame(node: FakeNode) -> dict[str, object]:
    """Return a live message of frames of now."""
    with node.running.socket("/api/v1/live?rate_hz=60") as live:
        node.deliver(40, now=True)
        return receive_live(live, lambda message: message["type"] == "frame")


def test_pages_have_pressures_until_models_are_compiled(
    compiled: Path, serve_with: ServeWith, node_of: NodeOf
) -> None:
    running = serve_with()
    node = node_of(running)
    node.connect()
    node.tared()
    assert running.node()["compiling"]
    session = node.record()
    node.deliver(300, [20.0, 60.0])
    answer = running.http.get(f"{session.url}/timeseries")
    assert "has no frames yet" in answer.json()["detail"]
    session.stop()
    before = receive_frame(node)
    assert before["grf_n"] is None
    assert before["force_n"] == [None, None]
    assert before["gauge_kpa"] == pytest.approx([0.0, 0.0], abs=1.0)
    assert session.now()["state"] != "sealed"
    compiled.touch()
    until(lambda: not is_compiling())
    until(lambda: not running.node()["compiling"])
    until(lambda: receive_frame(node)["grf_n"] is not None)
    until(lambda: session.now()["state"] == "sealed")
    assert "grf_n" in pq.read_schema(session.folder / "frames.parquet").names


def test_a_server_ends_its_compiling_process(
    compiled: Path, serve_with: ServeWith, tmp_path: Path
) -> None:
    serve_with()
    assert is_compiling()
    # `serve_with` ends it, and fails if a task is left over.


@pytest.mark.process
@pytest.mark.soak
def test_a_machine_without_compiled_code_has_pressures_at_once(tmp_path: Path) -> None:
    empty = {
        "NUMBA_CACHE_DIR": str(tmp_path / "numba"),
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }
    command = [sys.executable, "-c", "from service.cli.main import main; main()", "demo"]
    demo = subprocess.Popen(
        [*command, "--port=0", f"--data={tmp_path / 'data'}"],
        env={**os.environ, **empty},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert demo.stdout is not None
    try:
        address = demo.stdout.readline().split()[-1].partition("#")[0].rstrip("/")
        frames = list[dict[str, Any]]()
        with connect(f"ws{address[4:]}/api/v1/live?rate_hz=10", proxy=None) as live:
            while not frames or frames[-1]["grf_n"] is None:
                message = json.loads(live.recv(timeout=PATIENCE_S))
                frames += [message] if message["type"] == "frame" else []
        pressures = [f for f in frames if f["grf_n"] is None and f["gauge_kpa"][0] is not None]
        assert len(pressures) > 10
    finally:
        demo.terminate()
        demo.wait(PATIENCE_S)
        demo.stdout.close()
