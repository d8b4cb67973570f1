"""Messages of the link: what was damaged on its way is not heard."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import FileFormatError, LinkError
from service.link import Ack, FromServer, checked, heard, say, with_check

ACK = Ack(boot_id="0" * 32, seq_first=100, seq_last=199)


def test_a_message_is_json_and_comes_back() -> None:
    assert json.loads(say(ACK))["seq_last"] == 199
    assert FromServer.validate_json(heard(say(ACK))) == ACK


@given(at=st.integers(0, len(say(ACK)) - 1), bit=st.integers(0, 7))
def test_a_flipped_bit_of_a_text_is_noticed_wherever_it_is(at: int, bit: int) -> None:
    """A 1 that became a 9 would have the node forget frames that nobody has."""
    damaged = bytearray(say(ACK).encode())
    damaged[at] ^= 1 << bit
    with pytest.raises(LinkError, match="damaged"):
        heard(bytes(damaged))


@given(payload=st.binary(max_size=300), data=st.data())
def test_a_flipped_bit_of_frames_is_noticed_wherever_it_is(
    payload: bytes, data: st.DataObject
) -> None:
    message = bytearray(with_check(payload))
    assert checked(bytes(message)) == payload
    message[data.draw(st.integers(0, len(message) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(FileFormatError, match="damaged"):
        checked(bytes(message))


@pytest.mark.parametrize("message", [b"", b"abc", b"abcd"])
def test_what_is_too_short_is_damaged(message: bytes) -> None:
    with pytest.raises(FileFormatError):
        checked(message)
