"""Every example of docs/client.md, in its order, against one server with one node."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import foottile as client
from tests.builders.arrays import PERIOD_NS
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.process import Start
from tests.service.running import Running
from tests.waiting import until

PAGE = Path(__file__).parents[2] / "docs" / "client.md"
README = PAGE.parents[1] / "README.md"
URL = "http://laptop.local:8000"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)


@pytest.fixture
def left(running: Running, node_of: NodeOf) -> Iterator[FakeNode]:
    """A node `left` that streams while the test runs, and has for more than two seconds."""
    node = node_of(running, "left")
    node.connect()
    node.tared()
    with Play(node, 20.0):
        until(lambda: node.seq * PERIOD_NS > 3e9)
        yield node


@pytest.mark.slow
def test_every_python_example_runs(
    running: Running, left: FakeNode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, Any] = {}
    lacking = [name for name in ("pandas", "matplotlib") if find_spec(name) is None]
    for block in blocks("python"):
        if "to_pandas()" in block and lacking:
            continue
        exec(compile(block.replace(URL, running.url), str(PAGE), "exec"), names)  # noqa: S102  # our own page
    names["server"].close()
    assert len(names["grf_n"]) == len(names["force_n"]) == names["session"].frame_count
    assert names["session"].metadata["notes"] == "wetter than the second"
    assert Path("trial.parquet").stat().st_size == names["session"].metadata["bytes"]
    if lacking:
        pytest.skip(f"all but the notebook's: {', '.join(lacking)} is not installed")
    assert Path("trial.png").stat().st_size > 1000


@pytest.mark.slow
def test_the_readme_plots_what_was_pulled_over_seconds(
    running: Running,
    left: FakeNode,
    foottile: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("pandas", "matplotlib"):
        pytest.importorskip(name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    with client.connect(running.url) as server:
        with server.record("left", "a trial") as session:
            until(lambda: session.refresh().frame_count > 100)
        session.wait_until_sealed()
    pulled = foottile("pull", session.id, "--out", tmp_path / "here", "--server", running.url)
    assert pulled.ended() == 0, pulled.err
    (block,) = re.findall(r"```python\n(import pandas.*?)```", README.read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(block.replace("SESSION", session.id), str(README), "exec"), names)  # noqa: S102  # our own page
    (line,) = names["axes"].lines
    time_s, grf_n = line.get_data()
    assert len(time_s) == session.frame_count
    assert time_s[0] == 0.0
    assert time_s[-1] == pytest.approx(session.duration_s, abs=0.1)
    assert max(grf_n) > 10.0
    assert Path("grf.png").stat().st_size > 1000


@pytest.mark.slow
def test_every_line_for_the_shell_runs(
    running: Running, left: FakeNode, foottile: Start, tmp_path: Path
) -> None:
    (block,) = blocks("sh")
    for line in block.splitlines():
        arguments = shlex.split(line.partition("|")[0].partition(">")[0])
        assert arguments[0] == "foottile"
        process = foottile(*arguments[1:], "--frames", 3, "--server", running.url)
        assert process.ended() == 0, process.err
        assert len(process.out) == (3 if "jsonl" in line else 4)
        assert not process.err


@pytest.mark.slow
def test_the_matlab_example_runs_in_octave(
    running: Running, left: FakeNode, tmp_path: Path
) -> None:
    octave = shutil.which("octave-cli") or shutil.which("octave")
    if octave is None:
        pytest.skip("there is no Octave here")
    with client.connect(running.url) as server, server.record("left", "one") as session:
        session.add_marker("so")
    (block,) = blocks("matlab")
    block = "function websave(file, url), urlwrite(url, file); end\n" + block
    with client.connect(running.url) as server:
        server.session(session.id).wait_until_sealed()
    done = subprocess.run(
        [octave, "--no-init-file", "--eval", block.replace(URL, running.url)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "trial.csv").read_text().splitlines()[0].replace('"', "") == "t_ns,grf_n"
