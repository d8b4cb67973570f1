"""The command line as a user meets it: arguments in, exit code and two streams out."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from service.cli.main import main
from service.version import SOFTWARE_VERSION
from tests.service.cli.outcome import Outcome, Run

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"


@pytest.fixture
def run(
    tmp_path: Path,
    bench_cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Run:
    """Run `foottile ARGUMENTS` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(bench_cache))
    monkeypatch.setenv("COLUMNS", "200")

    def run_foottile(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["foottile", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
        out, err = capsys.readouterr()
        return Outcome(code, out, err)

    return run_foottile


@pytest.fixture
def bench(run: Run, bench_cache: Path) -> bytes:
    """A recording of tiles T01 and T02 under the mill, which takes seconds: made once."""
    kept = bench_cache / f"{SOFTWARE_VERSION}-T01,T02.parquet"
    if not kept.exists():
        made = f"{os.getpid()}.parquet"
        pressed = ("--tiles", "T01,T02", "--out", made)
        assert run("simulate", "--scene", "indentation", *pressed).code == 0
        shutil.move(made, kept)
    return kept.read_bytes()


@pytest.fixture
def recording() -> Callable[[str], Path]:
    """A real recording beside the project, or a skip that says which one is missing."""

    def find(name: str) -> Path:
        path = SHARED / name
        if not path.exists():
            pytest.skip(f"the real recording {path} is not here")
        return path

    return find
