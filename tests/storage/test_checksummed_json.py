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
def test_it_is_the_same_object_with_one_key_more(
    content: dict[str, object], indent: int | None
) -> None:
    text = append_json_checksum(json.dumps(content, indent=indent).encode())
    found = json.loads(text)
    assert len(found.pop("check")) == 64
    assert found == content
    assert json.loads(verify_and_strip_json_checksum(text, where="")) == content


@given(objects, st.data())
def test_every_flipped_bit_is_seen(content: dict[str, object], data: st.DataObject) -> None:
    text = bytearray(append_json_checksum(json.dumps(content, indent=1).encode()))
    at = data.draw(st.integers(0, len(text) - 1))
    text[at] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(DamagedFileError):
        verify_and_strip_json_checksum(bytes(text), where="")


@given(objects, st.data())
def test_a_byte_less_or_more_is_seen(content: dict[str, object], data: st.DataObject) -> None:
    whole = append_json_checksum(json.dumps(content, indent=1).encode())
    at = data.draw(st.integers(0, len(whole) - 1))
    more = data.draw(st.binary(min_size=1, max_size=2))
    for text in (whole[:at] + whole[at + 1 :], whole[:at] + more + whole[at:]):
        with pytest.raises(DamagedFileError):
            verify_and_strip_json_checksum(text, where="")


@given(objects, st.data())
def test_what_was_cut_or_has_zeros_at_its_end_is_damaged(
    content: dict[str, object], data: st.DataObject
) -> None:
    whole = append_json_checksum(json.dumps(content, indent=1).encode())
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    for text in (cut, cut + bytes(len(whole) - len(cut))):
        with pytest.raises(DamagedFileError, match=r"a\.json"):
            verify_and_strip_json_checksum(text, where="a.json")


def test_a_file_is_written_with_its_hash_and_read_without(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_checksummed_json(path, b'{"a": 1}')
    assert json.loads(read_checksummed_json(path)) == {"a": 1}


@pytest.mark.parametrize(
    "text", [b"", b" \n", bytes(300), b"\xff" * 300, b"null", b"[" * 100_000, b'{"a": 1}']
)
def test_what_states_no_hash_is_damaged(text: bytes) -> None:
    with pytest.raises(DamagedFileError, match=r"a\.json"):
        verify_and_strip_json_checksum(text, where="a.json")


def test_a_missing_file_is_missing_and_not_damaged(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_checksummed_json(tmp_path / "a.json")


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


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


@pytest.mark.parametrize("damage", [_empty, _cut, _flip, _folder, _link, _dangling, _pipe])
def test_what_is_not_the_file_that_was_written_is_damaged_and_can_be_set_aside(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    path = tmp_path / "a.json"
    write_checksummed_json(path, b'{"a": 1}')
    damage(path)
    with pytest.raises(DamagedFileError, match=r"a\.json"):
        read_checksummed_json(path)
    assert set_aside_damaged(path).name == "a.json.damaged-1"
    write_checksummed_json(path, b'{"a": 2}')
    assert set_aside_damaged(path).name == "a.json.damaged-2"
