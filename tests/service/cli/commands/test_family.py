"""A session of broad parts is estimated with a bench of broad parts, and no other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from devices.errors import CalibrationError
from service.offline.estimate import preparation
from tests.service.cli.outcome import Run, scene_text

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("family", ["default", "broad"])
def test_a_session_is_estimated_with_a_bench_of_its_own_family(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, family: str
) -> None:
    asked: list[Any] = []

    def no_bench(*_: object, **options: Any) -> object:
        asked.append((options["family"], options["parts_seed"]))
        raise CalibrationError("no bench here")

    monkeypatch.setattr(preparation, "find_calibration", no_bench)
    scene = tmp_path / "family.toml"
    scene.write_text(scene_text("standing") + f'\n[emulation]\nfamily = "{family}"\n')
    simulate = ("simulate", "--scene", scene, "--seconds", 0.5, "--parts-seed", 5)
    run(*simulate, "--no-estimates", "--out", "s.parquet").fails(0)
    again = ("estimate", "s.parquet", "--calibration", "emulated-rig", "--out", "e.parquet")
    run(*again).fails(1, "no bench here")
    assert asked == [(family, 5)]
