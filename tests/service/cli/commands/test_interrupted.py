"""Ctrl-C while a command runs: one line, code 130, and no file."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.service.cli.outcome import Run
from tests.waiting import PATIENCE_S, until

INTERRUPTED = "foottile: interrupted"


def has_file(process: subprocess.Popen[bytes], folder: Path) -> bool:
    return any(path.name.endswith(".tmp") for path in folder.iterdir())


def has_children(process: subprocess.Popen[bytes], folder: Path) -> bool:
    return bool(Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split())


def is_fitting(process: subprocess.Popen[bytes], folder: Path) -> bool:
    # The second tile: while modules are imported Python may lose a Ctrl-C in a callback of its own.
    return "tile T01" in (folder.parent / "stderr").read_text()


@pytest.mark.process
@pytest.mark.slow(parts=8)
@pytest.mark.parametrize(
    ("arguments", "has_begun"),
    [
        (["simulate", "--scene=standing", "--seconds=400", "--no-estimates"], has_file),
        (
            ["benchmark", "--scene=standing", "--draws=500", "--jobs=2", "--out=a/bench"],
            has_children,
        ),
        (["calibrate", "bench.parquet", "--out=cal.json", "--plot=cal.png"], is_fitting),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_ctrl_c_prints_one_line_and_leaves_no_file_and_no_process(
    tmp_path: Path,
    bench: Path,
    arguments: list[str],
    has_begun: Callable[[subprocess.Popen[bytes], Path], bool],
) -> None:
    folder = tmp_path / "here"
    folder.mkdir()
    bench.rename(folder / bench.name)
    # Tests that a shell starts in the background ignore Ctrl-C, and their children inherit that.
    hears = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"{hears}; from service.cli.main import main; main()"
    with (tmp_path / "stderr").open("wb") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=stderr,
        )
    try:
        until(lambda: process.poll() is not None or has_begun(process, folder))
        process.send_signal(signal.SIGINT)
        # And those that it started have ended, too.
        out, _ = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    lines = (tmp_path / "stderr").read_text().splitlines()
    assert lines[-1:] == [INTERRUPTED], lines
    assert not any("Traceback" in line for line in lines), lines
    assert (process.returncode, out) == (130, b"")
    assert [path.name for path in folder.iterdir()] == ["bench.parquet"]


@pytest.mark.parametrize(
    ("place", "arguments"),
    [
        ("service.offline.export.make_sealed_export", "export s.parquet --format csv --out x.csv"),
        ("storage.verify.data_folder.verify_path", "verify ."),
        ("service.sessions.recovery.recover_locked_folder", "recover data"),
        ("service.offline.estimate.session.estimate_session", "estimate s.parquet --out x.parquet"),
        ("service.offline.doctor.diagnose_bus", "doctor --bus emulated"),
        ("foottile.client.Client.sessions", "sessions"),
        ("service.pull.pull_session", "pull 20200101T000000Z-000000 --out x"),
    ],
)
def test_ctrl_c_in_any_other_command_prints_the_line(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, arguments: str
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    short = ("--seconds", 0.2, "--no-estimates", "--out", "s.parquet")
    if "s.parquet" in arguments:
        assert run("simulate", "--scene", "standing", *short).code == 0
    (tmp_path / "data" / "sessions").mkdir(parents=True)
    before = {path for path in tmp_path.rglob("*") if path.name != ".lock"}
    monkeypatch.setattr(place, interrupted)
    outcome = run(*arguments.split())
    assert (outcome.code, outcome.out) == (130, "")
    assert outcome.err.splitlines()[-1] == INTERRUPTED
    assert {path for path in tmp_path.rglob("*") if path.name != ".lock"} == before
