"""An installation without the extra `server`: what it does, and what it says of the rest.

Packages are really kept from being imported, in child processes, too.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tomllib
from contextlib import closing
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from storage.sessions.folder import FRAMES_NAME, SessionsFolder
from tests.service.cli.outcome import static_only
from tests.service.process import Process
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
BLOCKER = """
import sys
absent = ["fastapi", "httptools", "httpx", "psutil", "starlette", "uvicorn"]
absent += ["matplotlib", "uvloop", "zeroconf", "zeroconf.asyncio"]
if not any("spawn_main" in word for word in sys.orig_argv):
    absent += ["numba", "scipy"]  # which an emulated foot needs, where a robot has a real one
sys.modules.update(dict.fromkeys(absent))
"""


@pytest.fixture
def without_server(tmp_path: Path) -> dict[str, str]:
    """Environment of a process that has what `pip install foottile` brings."""
    folder = tmp_path / "blocker"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(BLOCKER)
    return {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}


def foottile(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from service.cli.main import main; main()"]
    return subprocess.run(
        [*command, *map(str, words)],
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )


@pytest.mark.slow
def test_a_node_that_records_alone_seals_raw_frames_and_estimates_are_added_later(
    tmp_path: Path, without_server: dict[str, str]
) -> None:
    scene = (ROOT / "devices" / "scene" / "builtin" / "standing.toml").read_text()
    (tmp_path / "foot.toml").write_text('calibration = "paper-eq2-shape"\n' + static_only(scene))
    words = ("--scene", tmp_path / "foot.toml", "--record", "trial", "--journal", tmp_path / "node")
    with closing(Process("node", *words, folder=tmp_path / "run", **without_server)) as node:
        node.said("tiles at")
        folder = SessionsFolder(tmp_path / "node" / "sessions")
        node.said("schedule")
        with pytest.raises(subprocess.TimeoutExpired):  # some seconds of frames: lead and load
            node.process.wait(4.0)
        node.process.send_signal(signal.SIGINT)
        assert node.ended() == 0, node.err
    (session_id,) = folder.list_ids_newest_first()
    session = folder.load(session_id)
    assert session.problem is not None
    assert session.problem.startswith("no estimates: the estimator needs numba")
    assert "`foottile estimate`" in session.problem
    assert session.calibration_id is None

    proof = foottile("verify", tmp_path / "node", **without_server)
    assert proof.returncode == 0, proof.stdout
    assert "complete" in proof.stdout

    frames = folder.get_path(session_id) / FRAMES_NAME
    estimated = foottile("estimate", frames, "--out", tmp_path / "estimated.parquet")
    assert estimated.returncode == 0, estimated.stderr
    grf_n = pq.read_table(tmp_path / "estimated.parquet")["grf_n"].to_numpy()
    assert len(grf_n) == session.frames
    assert grf_n[-50:].mean() > 3.0


NEEDS_EXTRA = {
    "serve": "server",
    "demo": "server",
    "simulate --scene standing": "server",
    "estimate in.parquet --out out.parquet": "server",
    "calibrate in.parquet --out out.json": "server",
    "benchmark --out .": "server",
    "sessions": "client",
    "pull id --out .": "client",
    "stream": "client",
    "find": "discovery",
    "doctor --bus emulated": "emulation",
}
RUN_EACH = """
import sys
from service.cli.main import main
for words in sys.argv[1:]:
    sys.argv = ["foottile", *words.split()]
    try:
        main()
    except SystemExit as end:
        print(end.code, file=sys.stderr)
"""


@pytest.mark.slow
def test_what_is_missing_is_named_with_the_extra_that_brings_it(
    tmp_path: Path, without_server: dict[str, str]
) -> None:
    """In one process: to start each takes half a second."""
    done = subprocess.run(
        [sys.executable, "-c", RUN_EACH, *NEEDS_EXTRA],
        cwd=tmp_path,
        env={**os.environ, **without_server},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    said = done.stderr.splitlines()
    assert said[1::2] == ["2"] * len(NEEDS_EXTRA), done.stderr
    for line, (words, extra) in zip(said[::2], NEEDS_EXTRA.items(), strict=True):
        assert f"pip install 'foottile[{extra}]'" in line, words


@pytest.mark.parametrize(
    ("lock", "left_out"),
    [
        ("requirements-dev.lock", {"rig", "bench", "opensim"}),
        ("requirements-lowest.lock", {"rig", "bench", "opensim", "dev"}),
    ],
)
def test_a_lock_is_compiled_from_every_extra_but_those_that_say_why_not(
    lock: str, left_out: set[str]
) -> None:
    command = (ROOT / lock).read_text().splitlines()[1]
    for extra in PROJECT["optional-dependencies"].keys() - left_out:
        assert f"--extra {extra}" in command


def test_all_locks_of_a_checkout_pin_the_same_versions() -> None:
    demo, dev = (
        set(re.findall(r"^[a-z0-9-]+==\S+", (ROOT / lock).read_text(), re.MULTILINE))
        for lock in ("requirements.lock", "requirements-dev.lock")
    )
    assert len({pin.split("==")[0] for pin in demo}) <= 60
    assert demo - dev == set()


def test_the_lowest_versions_that_are_declared_are_those_of_their_lock() -> None:
    text = (ROOT / "requirements-lowest.lock").read_text()
    pins = dict(re.findall(r"^([a-z0-9-]+)==(\S+) ", text, re.MULTILINE))
    product = PROJECT["optional-dependencies"].keys() - {"rig", "bench", "opensim", "dev"}
    declared = [
        *PROJECT["dependencies"],
        *(each for extra in product for each in PROJECT["optional-dependencies"][extra]),
    ]
    lowest = dict(
        pair for each in declared for pair in re.findall(r"^([a-z0-9-]+)>=([0-9.]+)", each)
    )
    assert len(lowest) > 20
    stale = {
        name: (pins.get(name), least)
        for name, least in lowest.items()
        if not f"{pins.get(name)}.".startswith(f"{least}.")
    }
    assert stale == {}
