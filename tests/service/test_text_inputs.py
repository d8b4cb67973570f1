"""Text files that people edit, in the encodings that editors of any system save them in."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.input_files import decode_text
from devices.scene.scene_file import load_scene
from service.api.settings import load_settings
from service.sessions.calibration_file import encode_calibration, parse_calibration
from tests.builders.calibrations import make_calibration

ENCODINGS = ("utf-8", "utf-8-sig", "utf-16")


@given(text=st.text().filter(lambda text: not text.startswith("\ufeff")))
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_text_is_the_same_whatever_its_byte_order_mark(encoding: str, text: str) -> None:
    if "\0" not in text:
        assert decode_text(text.encode(encoding)) == text


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_scenes_settings_and_calibrations_may_come_from_any_editor(
    tmp_path: Path, encoding: str
) -> None:
    scene = Path(__file__).parents[2] / "devices/scene/builtin/poppy.toml"
    (tmp_path / "own.toml").write_text(scene.read_text("utf-8"), encoding)
    assert load_scene(str(tmp_path / "own.toml")).ground == load_scene("poppy").ground
    (tmp_path / "server.toml").write_text("port = 8123\n", encoding)
    assert load_settings(tmp_path / "server.toml").port == 8123
    calibration = make_calibration()
    content = encode_calibration(calibration).decode().encode(encoding)
    assert parse_calibration(content, where="here") == calibration
