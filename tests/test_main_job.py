"""The main job, command by command, as installed in FOOTTILE_BIN: `scripts/lowest` sets it.

What each command does has its tests elsewhere. This one asks whether they work with the packages of
that environment.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
from contextlib import closing
from pathlib import Path

import httpx
import pytest

from storage.formats.writers.registry import FORMATS
from tests.service.process import Process
from tests.tokens import SHARED_BEARER
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.skipif(
    "FOOTTILE_BIN" not in os.environ, reason="scripts/lowest runs it in an environment of its own"
)

COMPILE_S = 700.0
"""In an environment that is new the first command compiles the models, beside other tests."""


def run(folder: Path, *words: object) -> str:
    """Run a command of that environment: what it prints."""
    done = subprocess.run(
        [Path(os.environ["FOOTTILE_BIN"]) / "foottile", *map(str, words)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=COMPILE_S,
    )
    assert done.returncode == 0, (words, done.stdout, done.stderr)
    return done.stdout


def test_a_session_is_recorded_served_pulled_proven_exported_compared_and_asked_about(
    tmp_path: Path,
) -> None:
    plate = ("--force-plate", "plate.csv")
    lag = ("--lag-range-s=-0.5,0.5",)  # else two fit: steps of the scene repeat
    run(tmp_path, "simulate", "--scene", "rolling", "--seconds", 8, "--out", "s.parquet", *plate)
    run(tmp_path, "compare", "s.parquet", "--reference", "plate.csv", "--out", "compared", *lag)
    with closing(Process("serve", "--port", 0, "--data", "data", folder=tmp_path)) as server:
        url = server.said("FootTile is at").split()[-1].rstrip("/")
        words = ("--scene", "standing", "--server", url, "--name", "leg", "--journal", "node")
        with closing(Process("node", *words, folder=tmp_path)) as node:
            node.said("connected to")
            with httpx.Client(
                base_url=f"{url}/api/v1", headers=SHARED_BEARER, timeout=PATIENCE_S
            ) as api:
                asked = {"node": "leg", "name": "main job"}
                begun = api.post("/sessions", json=asked).raise_for_status().json()
                route = f"/sessions/{begun['id']}"
                until(lambda: api.get(route).json()["frames"] > 200, PATIENCE_S)
                api.post(f"{route}/stop").raise_for_status()
                until(lambda: api.get(route).json()["state"] == "sealed", PATIENCE_S)
                assert api.get(route).json()["complete"] is True
            run(tmp_path, "pull", begun["id"], "--server", url, "--out", "pulled")
            node.process.send_signal(signal.SIGINT)
            assert node.ended() == 0, node.err
        server.process.send_signal(signal.SIGINT)
        assert server.ended() == 0, server.err
    assert "whole and complete" in run(tmp_path, "verify", "data")
    (frames,) = (tmp_path / "pulled").rglob("frames.parquet")
    for name in FORMATS:
        out = tmp_path / f"exported.{name}"
        body = ("--body", "calcn_r") if name == "opensim" else ()
        # OpenSim wants a centre of pressure, which so short a recording may not have.
        source = "s.parquet" if name == "opensim" else frames
        run(tmp_path, "export", source, "--format", name, "--out", out, *body)
        assert out.stat().st_size > 0
    question = "SELECT count(*) AS n FROM frames"
    answer = json.loads(run(tmp_path, "query", question, "data", "--json"))
    assert answer["left_out"] == {}
    assert answer["rows"][0]["n"] > 200
