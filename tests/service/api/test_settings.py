"""Settings from the environment and from files."""

from __future__ import annotations

from pathlib import Path

import pytest

from devices.errors import UsageError
from service.api.settings import Settings, load_settings


@pytest.fixture(autouse=True)
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in Settings.model_fields:
        monkeypatch.delenv(f"FOOTTILE_{name.upper()}", raising=False)


@pytest.mark.parametrize("name", [name.upper() for name in Settings.model_fields])
def test_an_empty_variable_is_not_set(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = load_settings(None)
    for empty in ("", "\r", '""'):
        monkeypatch.setenv(f"FOOTTILE_{name}", empty)
        assert load_settings(None) == usual


@pytest.mark.parametrize("value", ["robot.local,lab", "robot.local lab", '["robot.local", "lab"]'])
def test_one_variable_has_several_names(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FOOTTILE_ALLOW_HOST", value)
    assert load_settings(None).allow_host == ("robot.local", "lab")


def test_a_wrong_value_is_refused_with_its_variable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("FOOTTILE_PORT", "eight")
    with pytest.raises(UsageError, match="FOOTTILE_PORT"):
        load_settings(None)


def test_a_file_may_have_a_byte_order_mark_and_no_wrong_key(tmp_path: Path) -> None:
    config = tmp_path / "foottile.toml"
    config.write_bytes(b"\xef\xbb\xbfport = 8001\r\nallow_host = ['robot.local']\r\n")
    settings = load_settings(config)
    assert (settings.port, settings.allow_host) == (8001, ("robot.local",))
    for text in ('data = ""', "port = ", "prot = 1", "data = '\xff'"):
        config.write_bytes(text.encode("latin-1"))
        with pytest.raises(UsageError, match=r"foottile\.toml"):
            load_settings(config)
