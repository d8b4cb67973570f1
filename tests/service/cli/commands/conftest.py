"""A session that several commands are tried on."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.service.cli.outcome import Simulate, scene_text, static_only


@pytest.fixture
def session(simulate: Simulate) -> Path:
    """Ten seconds of `poppy` with the paper's curve and its truth."""
    scene = 'calibration = "paper-eq2-shape"\n' + static_only(scene_text("poppy"))
    return simulate("session.parquet", scene, "--seconds", 10, "--truth")
