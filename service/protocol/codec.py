"""Encoding of messages, checksums, close codes, and the tasks of a connection.

Every message of the link has a CRC-32 (zlib), because neither websockets nor Arrow detect a
flipped bit: the last four bytes of a binary message, little endian, over all before; the last field
of a text message, `"crc32"` with eight hex digits, over the text before its comma. A message with a
wrong CRC-32 ends the connection, and its content is sent again. Live messages have none.
"""

from __future__ import annotations

import asyncio
import re
import zlib
from collections.abc import Awaitable
from enum import IntEnum
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from service.protocol.link import LinkMessage
from service.user_folders import strip_private_folders

if TYPE_CHECKING:  # a node needs no shapes of pages
    from service.protocol.live import LiveMessage

_REASON_BYTES_MAX = 123
_CRC_BYTES = 4
_TEXT_WITH_CRC = re.compile(r'(\{.*),"crc32":"([0-9a-f]{8})"\}', re.DOTALL)

_T = TypeVar("_T")


class LinkCloseCode(IntEnum):
    """Close codes of foottile's websockets (4000 to 4999 are private to the application)."""

    POLICY = 1008
    TOO_BIG = 1009
    BUG = 1011
    RESTART = 1012
    TRY_LATER = 1013
    REFUSED = 4001
    """Valid message, invalid content."""
    WRONG_VERSION = 4002
    MALFORMED = 4004
    """Message damaged in transit."""
    SILENT = 4005
    TOO_SLOW = 4008
    NAME_TAKEN = 4009
    SUPERSEDED = 4010
    NO_STREAM = 4011
    """A requested stream does not exist, or no longer."""
    UNREADABLE = 4012
    """Stored frames cannot be read, permanently."""
    WRONG_IDENTITY = 4013
    """The node's name belongs to another machine, until a person accepts this one."""


class CloseConnection(Exception):  # noqa: N818  # no error: how a connection ends
    """Request of a connection's handler to close it with a code and a reason."""

    def __init__(self, code: LinkCloseCode, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


def encode_link_message(message: LinkMessage) -> str:
    """Encode a message of the link as JSON with its checksum."""
    return append_text_crc(message.model_dump_json())


def decode_link_message(messages: TypeAdapter[_T], text: str | bytes) -> _T:
    """Verify the checksum of a message of the link, and decode it.

    Args:
        messages: `NODE_MESSAGES` or `SERVER_MESSAGES`.
        text: JSON with its checksum.

    Raises:
        CloseConnection: it was damaged on its way, is no such message, or a value is out of bounds.
    """
    return decode_message(messages, strip_text_crc(text))


def encode_message(message: LiveMessage) -> str:
    """Encode a live message as JSON."""
    return message.model_dump_json()


def decode_message(messages: TypeAdapter[_T], text: str) -> _T:
    """Decode a message without a checksum.

    Raises:
        CloseConnection: it is no such message, or a value is out of bounds.
    """
    try:
        # Strict: true is not 1, and "1" neither.
        return messages.validate_json(text, strict=True)
    except ValidationError as error:
        raise CloseConnection(
            LinkCloseCode.REFUSED, f"message not understood: {_describe_complaint(error)}"
        ) from error


def _describe_complaint(error: ValidationError) -> str:
    """Return the place and the reason of the first complaint."""
    complaint = error.errors(include_url=False, include_input=False, include_context=False)[0]
    where = ".".join(str(part)[:60] for part in complaint["loc"])
    return f"{where}: {complaint['msg']}" if where else str(complaint["msg"])


def append_text_crc(text: str) -> str:
    """Append the checksum to a JSON object."""
    return f'{text[:-1]},"crc32":"{zlib.crc32(text[:-1].encode()):08x}"}}'


def strip_text_crc(text: str | bytes) -> str:
    """Verify the checksum of a text message and return the JSON without it.

    Raises:
        CloseConnection: the checksum is wrong or missing.
    """
    text = text.decode(errors="replace") if isinstance(text, bytes) else text
    found = _TEXT_WITH_CRC.fullmatch(text)
    if found is None or int(found[2], 16) != zlib.crc32(found[1].encode()):
        raise CloseConnection(
            LinkCloseCode.MALFORMED,
            "a message was damaged on its way; expected the CRC-32 of its text",
        )
    return found[1] + "}"


def append_crc(payload: bytes) -> bytes:
    """Append the checksum to encoded frames, for a binary message."""
    return payload + zlib.crc32(payload).to_bytes(_CRC_BYTES, "little")


def strip_binary_crc(message: bytes) -> bytes:
    """Verify the checksum of a binary message and return the encoded frames.

    Raises:
        CloseConnection: the checksum is wrong or missing.
    """
    payload, check = message[:-_CRC_BYTES], message[-_CRC_BYTES:]
    if len(check) < _CRC_BYTES or zlib.crc32(payload) != int.from_bytes(check, "little"):
        raise CloseConnection(
            LinkCloseCode.MALFORMED,
            "a message of frames was damaged on its way; expected the CRC-32 of its bytes",
        )
    return payload


def format_close_reason(text: str) -> str:
    """Format a reason for a close frame and a log: 123 bytes (RFC 6455 5.5) in one line."""
    text = strip_private_folders(text)
    plain = "".join(char if char.isprintable() else "?" for char in text[:_REASON_BYTES_MAX])
    return plain.encode()[:_REASON_BYTES_MAX].decode(errors="ignore")


async def run_until_first_ends(*work: Awaitable[Any]) -> None:
    """Run tasks of a connection until one ends, cancel the others, and raise its exception.

    Without a TaskGroup: before Python 3.13 a group that ends while its owner is about to resume may
    leave the owner cancelled (CPython 117407), and a node without its link.
    """
    tasks = [asyncio.ensure_future(each) for each in work]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for task in tasks:
        if task in done:
            task.result()
