"""An archive of four short sessions, made once, and copies of it to be changed."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.service.offline.archives import sealed

PEAKS_N = ((20.0, 30.0), (24.0, 34.0), (50.0, 20.0), (20.0, 45.0))


@pytest.fixture(scope="session")
def made_archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    data = tmp_path_factory.mktemp("sessions")
    for number, peaks_n in enumerate(PEAKS_N):
        sealed(data, number, *peaks_n)
    return data


@pytest.fixture
def archive(made_archive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made_archive, tmp_path / "data"))
