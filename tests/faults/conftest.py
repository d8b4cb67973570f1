"""Small programs in processes of their own, watched, for the harness's own tests."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from tests.faults.power import Disk
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Ended:
    code: int
    out: str


Run = Callable[..., Ended]


@pytest.fixture
def disk(tmp_path: Path) -> Disk:
    """A watched folder with nothing in it."""
    return Disk(tmp_path / "root", tmp_path / "beside", tmp_path / "synced")


@pytest.fixture
def run_on() -> Run:
    """Run Python code in a watched folder; it ends by itself or is killed."""

    def run_code(disk: Disk, code: str, **environment: str) -> Ended:
        ended = subprocess.run(
            [sys.executable, "-c", code],
            cwd=disk.root,
            env={**os.environ, **disk.environment(), **environment},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
        )
        assert not ended.stderr, ended.stderr
        return Ended(ended.returncode, ended.stdout)

    return run_code


@pytest.fixture
def run(disk: Disk, run_on: Run) -> Run:
    """The same in a folder that is made for the test."""
    return partial(run_on, disk)
