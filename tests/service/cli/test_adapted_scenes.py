"""Scenes that options adapt: real pins are not driven beside an emulated bus."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest

from service.cli.options import load_adapted_scene


@pytest.mark.parametrize(
    ("own", "asked", "has_lines"),
    [
        ("/dev/i2c-1", None, True),
        ("/dev/i2c-1", "/dev/i2c-2", True),
        ("/dev/i2c-1", "emulated", False),
        ("emulated", "emulated", True),
        ("emulated", None, True),
    ],
)
def test_a_real_scene_that_is_emulated_has_no_sync_lines(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    own: str,
    asked: str | None,
    has_lines: bool,
) -> None:
    text = (resources.files("devices.scene") / "builtin" / "standing.toml").read_text("utf-8")
    text = text.replace("[array]\n", f'[array]\nbus = "{own}"\n')
    path = tmp_path / "leg.toml"
    path.write_text(text + "\n[sync]\ninput_line = 17\n")
    scene = load_adapted_scene(str(path), bus=asked, servo=None)
    assert (scene.sync is not None) == has_lines
    assert ("[sync] are not used" in capsys.readouterr().err) != has_lines
