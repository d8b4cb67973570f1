"""The link between node and server, `foottile.v1`: what each side says, and why it hangs up.

    node                                  server
    hello (arrays, what it has)      -->
                                     <--  welcome (what the server lacks, what sessions need)
    stream, then Arrow messages      -->
                                     <--  ack (what is on the server's disk)
                                     <--  wanted (what sessions need now)
    probe                            <->  probe        eight at a time, for the clocks' offset
    clock, status, lost              -->

Text messages are JSON with a `type`; a binary message is a record batch (`storage.wire`) of the
stream that the node named last. Newest frames go first; what the server lacks of the past, of this
stream and of earlier ones, follows behind them. The node forgets nothing that a session needs and
that is not acknowledged; a new connection begins with hello again. Frames may come twice and in any
order: a server takes each (stream, seq) once.

Every message carries a CRC-32 (zlib), because neither websockets nor Arrow notice a flipped bit:
the last four bytes of a binary message, little endian, of all before; the last field of a text
message, `"crc32"` with eight hex digits, of the text before its comma. A message that does not
agree with it ends the connection, and what was in it is sent once more.
"""

from __future__ import annotations

import re
import zlib
from enum import IntEnum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from devices.errors import FileFormatError, LinkError
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration

SUBPROTOCOL = "foottile.v1"
PROTOCOL = 2
INGEST_PATH = "/api/v1/ingest"
LIVE_PATH = "/api/v1/live"
MESSAGE_BYTES_MAX = 1 << 20
"""Longest message either side takes. A batch of 64 tiles is 0.1 MB."""
SILENCE_S = 5.0
"""A side that has heard nothing for this long takes the link for dead."""
PROBES = 8
_REASON_BYTES_MAX = 123
_CHECK_BYTES = 4
_CHECKED = re.compile(r'(\{.*),"crc32":"([0-9a-f]{8})"\}', re.DOTALL)

_Seq = Annotated[int, Field(ge=0, lt=2**62)]
_Ns = Annotated[int, Field(ge=-(2**63), lt=2**63)]


class Close(IntEnum):
    """Close codes of foottile's websockets (4000 to 4999 are private to the application)."""

    POLICY = 1008
    TOO_BIG = 1009
    RESTART = 1012
    TRY_LATER = 1013
    BAD_HELLO = 4001
    WRONG_VERSION = 4002
    MALFORMED = 4004
    SILENT = 4005
    TOO_SLOW = 4008
    NAME_TAKEN = 4009
    SUPERSEDED = 4010


class HangUp(Exception):  # noqa: N818  # no error: how a connection ends
    """Raised by whoever serves a connection to end it with a code and a reason."""

    def __init__(self, code: Close, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


Pairs = tuple[tuple[_Seq, _Seq], ...]
"""Numbers as closed intervals."""
PairsByReason = dict[Annotated[str, Field(pattern=r"^[a-z_]{1,40}$")], Pairs]


class EarlierStream(_Message):
    """An ended stream of this node, if the node still has frames of it or knows losses."""

    array_info: ArrayInfo
    held: Pairs
    """What it has."""
    next_seq: _Seq
    """The number after the last frame that it knows of."""
    lost: PairsByReason = {}
    """Numbers that it should have and does not have, by reason."""
    unsynced_tail_max: Annotated[int, Field(ge=0)] = 0
    """How many more frames there may have been: its power failed. 0: it ended in order, or was
    killed, which loses nothing."""
    missed_slots: Annotated[int, Field(ge=0)] = 0
    t_ns_first: _Ns = 0
    """Instant of the oldest frame that it has, in the node's UTC."""


class Hello(_Message):
    """Who the node is, and what it can give."""

    type: Literal["hello"] = "hello"
    protocol: int
    array_info: ArrayInfo
    held: Pairs
    """What it has of its present stream."""
    next_seq: _Seq
    """The number of the next frame to be taken."""
    lost: PairsByReason = {}
    """Numbers of its present stream that it should have and does not have, by reason."""
    scene: dict[str, Any]
    """The scene file's content."""
    emulated: bool
    calibration: Calibration | None
    calibration_problem: str | None
    """Why there is none."""
    earlier: tuple[EarlierStream, ...] = ()
    """Its streams before this one, oldest first."""
    has_more: bool = False
    """Are there more, which did not fit? They are announced once these are delivered."""


class StreamNumbers(_Message):
    """Numbers of one stream."""

    boot_id: str
    numbers: tuple[tuple[_Seq, _Seq | None], ...]
    """An interval without an end goes on with every frame to come."""


class Wanted(_Message):
    """What sessions need: the node keeps it until it is acknowledged, whatever its age."""

    type: Literal["wanted"] = "wanted"
    streams: tuple[StreamNumbers, ...]
    """Not yet sealed, by stream."""
    recording: bool
    """Is a session being recorded, so that a stream that begins now belongs to it from its first
    frame on?"""


class Welcome(_Message):
    """What the server lacks, and what sessions need."""

    type: Literal["welcome"] = "welcome"
    protocol: int
    server_id: str = ""
    """Name of its data folder: one server cannot give up what another one needs."""
    lacks: tuple[StreamNumbers, ...]
    """Of the present stream everything that the node has and the server has not, of earlier ones
    what sessions need. The present stream's last interval has no end."""
    wanted: Wanted


class Ack(_Message):
    """These frames are on the server's disk: the node may forget them."""

    type: Literal["ack"] = "ack"
    boot_id: str
    seq_first: _Seq
    seq_last: _Seq


class FramesOf(_Message):
    """The frames that follow are of this stream."""

    type: Literal["stream"] = "stream"
    boot_id: str


class Probe(_Message):
    """Asks for the server's clock; comes back with it."""

    type: Literal["probe"] = "probe"
    id: _Seq
    server_t_ns: _Ns | None = None
    """The server's UTC; None on the way there."""


class ClockRow(_Message):
    """The best of eight probes. An offset that was not measured is not sent."""

    type: Literal["clock"] = "clock"
    t_mono_ns: _Ns
    server_minus_node_ns: _Ns
    """The server's UTC minus the `t_ns` that a frame taken now would have."""
    uncertainty_ns: Annotated[int, Field(ge=0, lt=2**63)]
    """Half the round trip: the server's reading lies somewhere in it."""


class Lost(_Message):
    """All that the node has lost of its present stream so far; sent whenever that changes."""

    type: Literal["lost"] = "lost"
    boot_id: str
    lost: PairsByReason


class Status(_Message):
    """What the node counts beside its frames; each second."""

    type: Literal["status"] = "status"
    missed_slots: Annotated[int, Field(ge=0)]
    backlog_frames: Annotated[int, Field(ge=0)] = 0
    """Frames that the server lacks and the node has; they are sent after the newest ones."""
    troubles: tuple[str, ...] = ()
    """What is wrong with the array or with the node's disk now, in words."""
    counts: dict[str, dict[str, Annotated[int, Field(ge=0)]]] = {}
    """How often what went wrong in this stream, by serial and reason."""


SaidByNode = Hello | FramesOf | Probe | ClockRow | Status | Lost
SaidByServer = Welcome | Ack | Wanted | Probe
FromNode: TypeAdapter[SaidByNode] = TypeAdapter(Annotated[SaidByNode, Field(discriminator="type")])
FromServer: TypeAdapter[SaidByServer] = TypeAdapter(
    Annotated[SaidByServer, Field(discriminator="type")]
)


def say(message: BaseModel) -> str:
    """A message as text, with its checksum."""
    body = message.model_dump_json()[:-1]
    return f'{body},"crc32":"{zlib.crc32(body.encode()):08x}"}}'


def heard(text: str | bytes) -> str:
    """A text message without its checksum.

    Raises:
        LinkError: they do not agree, or there is none.
    """
    text = text.decode(errors="replace") if isinstance(text, bytes) else text
    found = _CHECKED.fullmatch(text)
    if found is None or int(found[2], 16) != zlib.crc32(found[1].encode()):
        raise LinkError("a message was damaged on its way", expected="the CRC-32 of its text")
    return found[1] + "}"


def with_check(payload: bytes) -> bytes:
    """A binary message: frames with their checksum."""
    return payload + zlib.crc32(payload).to_bytes(_CHECK_BYTES, "little")


def checked(message: bytes) -> bytes:
    """The frames of a binary message.

    Raises:
        FileFormatError: they do not agree with their checksum.
    """
    payload, check = message[:-_CHECK_BYTES], message[-_CHECK_BYTES:]
    if len(check) < _CHECK_BYTES or zlib.crc32(payload) != int.from_bytes(check, "little"):
        raise FileFormatError(
            "a message of frames was damaged on its way", expected="the CRC-32 of its bytes"
        )
    return payload


def close_reason(text: str) -> str:
    """A reason as a close frame can carry it: 123 bytes (RFC 6455 5.5)."""
    return text.encode()[:_REASON_BYTES_MAX].decode(errors="ignore")
