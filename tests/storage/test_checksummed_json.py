"""An object with a hash of its own text."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import DamagedFileError
from storage.checksummed_json import (
    append_json_checksum,
    read_checksummed_json,
    verify_and_strip_json_checksum,
    write_checksummed_json,
)
from storage.durable_files import set_aside_damaged

objects = st.dictionaries(
    st.text(max_size=5).filter(lambda key: key != "check"),
    st.one_of(st.text(max_size=10), st.integers(), st.none(), st.lists(st.booleans(), max_size=2)),
    min_size=1,
    max_size=4,
)


@given(objects, st.sampled_from([None, 0, 1]))
def test_an_object_has_one_key_more(content: dict[str, object], indent: int | None) -> None:
    text = append_json_checksum(json.dumps(content, indent=indent).encode())
    found = json.loads(text)
    assert len(found.pop("check")) == 64
    assert found == content
    assert json.loads(verify_and_strip_json_checksum(text, where="")) == content


@given(objects, st.data())
def test_any_damage_is_seen(content: dict[str, object], data: st.DataObject) -> None:
    """A flipped bit, a byte less, bytes more, a cut, and a cut with zeros behind it."""
    whole = append_json_checksum(json.dumps(content, indent=1).encode())
    at = data.draw(st.integers(0, len(whole) - 1))
    flipped = bytes([whole[at] ^ 1 << data.draw(st.integers(0, 7))])
    more = data.draw(st.binary(min_size=1, max_size=2))
    changed = [
        whole[:at] + middle + whole[at + 1 :]
        for middle in (flipped, b"", more + whole[at : at + 1])
    ]
    for text in (*changed, whole[:at], whole[:at] + bytes(len(whole) - at)):
        with pytest.raises(DamagedFileError, match=r"a\.json"):
            verify_and_strip_json_checksum(text, where="a.json")


@pytest.mark.parametrize(
    "text", [b"", b" \n", bytes(300), b"\xff" * 300, b"null", b"[" * 100_000, b'{"a": 1}']
)
def test_what_states_no_hash_is_damaged(text: bytes) -> None:
    with pytest.raises(DamagedFileError, match=r"a\.json"):
        verify_and_strip_json_checksum(text, where="a.json")


def test_a_missing_file_is_missing_and_not_damaged(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_checksummed_json(tmp_path / "a.json")


def _flip(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"1", b"3", 1))


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _link(path: Path) -> None:
    path.rename(path.with_name("elsewhere.json"))
    path.symlink_to("elsewhere.json")


def _dangling(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere.json")


def _pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize("damage", [_flip, _folder, _link, _dangling, _pipe])
def test_anything_but_the_written_file_is_damaged_and_set_aside(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    path = tmp_path / "a.json"
    write_checksummed_json(path, b'{"a": 1}')
    damage(path)
    with pytest.raises(DamagedFileError, match=r"a\.json"):
        read_checksummed_json(path)
    assert set_aside_damaged(path).name == "a.json.damaged-1"
    write_checksummed_json(path, b'{"a": 2}')
    assert json.loads(read_checksummed_json(path)) == {"a": 2}
    assert set_aside_damaged(path).name == "a.json.damaged-2"
