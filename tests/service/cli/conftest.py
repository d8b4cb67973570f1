"""The command line as a user meets it, and the recordings that several commands are tried on."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from service.cli.main import main
from service.version import compute_exact_version
from tests.service.cli.outcome import Outcome, Run, Simulate, short_rig

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
def simulate(run: Run, tmp_path: Path, bench_cache: Path) -> Simulate:
    """Put a recording of a scene into the test's folder; tests that ask for the same share it.

    The scene is a built-in one's name or the text of a scene file.
    """

    def put(name: str, scene: str, *options: object) -> Path:
        asked = repr((compute_exact_version(), scene, options)).encode()
        kept = bench_cache / f"simulated-{hashlib.sha256(asked).hexdigest()[:16]}.parquet"
        if not kept.exists():
            made = bench_cache / f"{os.getpid()}.parquet"
            file = made.with_suffix(".toml")
            file.write_text(scene)
            source = file if "\n" in scene else scene
            run("simulate", "--scene", source, *options, "--out", made).succeeds()
            made.rename(kept)
        return Path(shutil.copy(kept, tmp_path / name))

    return put


@pytest.fixture
def bench(simulate: Simulate) -> Path:
    """Tiles T01 and T02 under the indenter: `bench.parquet` in the test's folder."""
    return simulate("bench.parquet", short_rig(), "--tiles", "T01,T02")


@pytest.fixture
def recording() -> Callable[[str], Path]:
    """Find a real recording beside the project, or skip the test and name it."""

    def find(name: str) -> Path:
        path = SHARED / name
        if not path.exists():
            pytest.skip(f"the real recording {path} is not here")
        return path

    return find
