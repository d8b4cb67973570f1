"""A session that several commands are tried on."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from service.version import SOFTWARE_VERSION
from tests.service.cli.outcome import Run, scene_text, static_only


@pytest.fixture
def session(run: Run, tmp_path: Path, bench_cache: Path) -> Path:
    """Ten seconds of `poppy` with the paper's curve and its truth; made once."""
    kept = bench_cache / f"{SOFTWARE_VERSION}-compare.parquet"
    if not kept.exists():
        scene = 'calibration = "paper-eq2-shape"\n' + static_only(scene_text("poppy"))
        (tmp_path / "scene.toml").write_text(scene)
        made = f"{os.getpid()}.parquet"
        asked = ("--scene", "scene.toml", "--seconds", "10", "--truth", "--out", made)
        assert run("simulate", *asked).code == 0
        shutil.move(made, kept)
    return Path(shutil.copy(kept, tmp_path / "session.parquet"))
