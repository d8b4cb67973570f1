"""An object with a hash of its own text."""

from __future__ import annotations

import json

from hypothesis import given
from hypothesis import strategies as st

from storage.durable import is_unchanged, with_check, without_check

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
    text = with_check(json.dumps(content, indent=indent).encode())
    found = json.loads(text)
    assert len(found.pop("check")) == 64
    assert found == content
    assert json.loads(without_check(text)) == content
    assert is_unchanged(text) is True


@given(objects, st.data())
def test_every_flipped_bit_is_seen(content: dict[str, object], data: st.DataObject) -> None:
    text = bytearray(with_check(json.dumps(content, indent=1).encode()))
    at = data.draw(st.integers(0, len(text) - 1))
    text[at] ^= 1 << data.draw(st.integers(0, 7))
    if is_unchanged(bytes(text)) is True:
        raise AssertionError(bytes(text))
    if is_unchanged(bytes(text)) is None:  # its end is broken: either no JSON, or a key too many
        try:
            found = json.loads(bytes(text))
        except ValueError:
            return
        assert set(found) - set(content)


def test_an_object_without_is_left_as_it_is() -> None:
    assert without_check(b'{"a": 1}') == b'{"a": 1}'
    assert is_unchanged(b'{"a": 1}') is None
