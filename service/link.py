"""The link between node and server, `foottile.v1`: what each side says, and why it hangs up.

    node                                  server
    identify (its name)              -->
                                     <--  challenge (a nonce)
    proof, hello (what it has)       -->
                                     <--  welcome (what the server lacks, what sessions need)
    stream, then Arrow messages      -->
                                     <--  ack (what is on the server's disk)
                                     <--  wanted (what sessions need now)
    probe                            <->  probe        eight at a time, for the clocks' offset
    clock, status, lost              -->

Text messages are JSON with a `type`; a binary message is a record batch (`storage.wire`) of the
stream that the node named last. Newest frames go first; what the server lacks of the past, of this
stream and of earlier ones, follows behind them. The node forgets nothing that a session needs and
that is not acknowledged; a new connection begins with identify again. Frames may come twice and in
any order: a server takes each (stream, seq) once.

A node proves that it is the machine that had its name before: `service.identity`.

Every message carries a CRC-32 (zlib), because neither websockets nor Arrow notice a flipped bit:
the last four bytes of a binary message, little endian, of all before; the last field of a text
message, `"crc32"` with eight hex digits, of the text before its comma. A message that does not
agree with it ends the connection, and what was in it is sent once more.
"""

from __future__ import annotations

import re
import zlib
from enum import IntEnum
from typing import Annotated, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from devices.errors import FileFormatError, LinkError
from devices.facts import Count, Facts, Label, OffsetNs, Seq, Text, TMonoNs, TNs
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.private_paths import without_folders
from service.scene_content import SceneContent
from storage.intervals import NO_END

_T = TypeVar("_T")

SUBPROTOCOL = "foottile.v1"
PROTOCOL = 3
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

_PAIRS_MAX = 1 << 14
"""Intervals in a list: a gap every ten seconds for two days."""
_STREAMS_MAX = 256
_REASONS_MAX = 32
_TROUBLES_MAX = 1000
UNCERTAINTY_MAX_NS = 60_000_000_000
"""No probe that took longer tells anything."""
BOOT_ID = r"[0-9a-f]{32}"
_AnySeq = Annotated[int, Field(ge=0, le=NO_END)]
"""Of a frame, or after the last that there can be."""

BootId = Annotated[str, Field(pattern=f"^{BOOT_ID}$")]
"""Name of a stream."""
_Hex256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Close(IntEnum):
    """Close codes of foottile's websockets (4000 to 4999 are private to the application)."""

    POLICY = 1008
    TOO_BIG = 1009
    BUG = 1011
    RESTART = 1012
    TRY_LATER = 1013
    REFUSED = 4001
    """What was said arrived whole, and cannot be."""
    WRONG_VERSION = 4002
    MALFORMED = 4004
    """What was said was damaged on its way."""
    SILENT = 4005
    TOO_SLOW = 4008
    NAME_TAKEN = 4009
    SUPERSEDED = 4010
    NO_STREAM = 4011
    """A stream that was asked for is not here, or not any more."""
    UNREADABLE = 4012
    """Frames that are kept cannot be read, and that will not mend by itself."""
    WRONG_IDENTITY = 4013
    """The name belongs to another machine, until a person accepts this one."""


class HangUp(Exception):  # noqa: N818  # no error: how a connection ends
    """Raised by whoever serves a connection to end it with a code and a reason."""

    def __init__(self, code: Close, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


def _rise(pairs: tuple[tuple[int, int | None], ...]) -> tuple[tuple[int, int | None], ...]:
    end: int | None = -1
    for first, last in pairs:
        if end is None or first <= end or (last is not None and last < first):
            raise ValueError("intervals have to rise, and none may be empty")
        end = last
    return pairs


def _are_none_empty(
    pairs: tuple[tuple[int, int | None], ...],
) -> tuple[tuple[int, int | None], ...]:
    if any(last is not None and last < first for first, last in pairs):
        raise ValueError("an interval is empty")
    return pairs


Pairs = Annotated[tuple[tuple[Seq, Seq], ...], Field(max_length=_PAIRS_MAX), AfterValidator(_rise)]
"""Numbers as closed intervals, in order."""
PairsByReason = Annotated[
    dict[Annotated[str, Field(pattern=r"^[a-z_]{1,40}$")], Pairs], Field(max_length=_REASONS_MAX)
]


class Identify(Facts):
    """First message: which node connects."""

    type: Literal["identify"] = "identify"
    protocol: Count
    node: Label


class Challenge(Facts):
    """Request for a proof that the node is the machine that had its name before."""

    type: Literal["challenge"] = "challenge"
    protocol: Count
    server_id: Label
    """Name of the server's data folder: a node shares one secret with each."""
    nonce: _Hex256
    """Random, for this connection only."""
    is_known: bool
    """Does the server have a secret of this node? If not, it takes the one that the node sends."""


class Proof(Facts):
    """Answer to `challenge`. A node whose disk keeps no secret sends neither field."""

    type: Literal["proof"] = "proof"
    proof: _Hex256 | None = None
    """`service.identity.make_proof`."""
    secret: _Hex256 | None = None
    """The secret itself: at first contact, or where a person has to accept this machine."""


class EarlierStream(Facts):
    """An ended stream of this node, if the node still has frames of it or knows losses."""

    array_info: ArrayInfo
    held: Pairs
    """What it has."""
    next_seq: Seq
    """The number after the last frame that it knows of."""
    lost: PairsByReason = Field(default={})
    """Numbers that it should have and does not have, by reason."""
    unsynced_tail_max: Count = 0
    """How many more frames there may have been: its power failed. 0: it ended in order, or was
    killed, which loses nothing."""
    missed_slots: Count = 0
    t_ns_first: TNs = 0
    """Instant of the oldest frame that it has, in the node's UTC."""


class Hello(Facts):
    """Who the node is, and what it can give."""

    type: Literal["hello"] = "hello"
    protocol: Count
    array_info: ArrayInfo
    held: Pairs
    """What it has of its present stream."""
    next_seq: Seq
    """The number of the next frame to be taken."""
    t_mono_ns: TMonoNs
    """The clock that stamps its frames, read when this message was made."""
    lost: PairsByReason = Field(default={})
    """Numbers of its present stream that it should have and does not have, by reason."""
    t_ns_first: TNs = 0
    """Instant of the oldest frame that it has of its present stream, in its UTC; 0: it has none."""
    scene: SceneContent
    """The scene file's content."""
    emulated: bool
    calibration: Calibration | None
    calibration_problem: Text | None
    """Why there is none."""
    earlier: Annotated[tuple[EarlierStream, ...], Field(max_length=_STREAMS_MAX)] = ()
    """Its streams before this one, oldest first."""
    has_more: bool = False
    """Are there more, which did not fit? They are announced once these are delivered."""


class StreamNumbers(Facts):
    """Numbers of one stream."""

    boot_id: BootId
    numbers: Annotated[
        tuple[tuple[_AnySeq, _AnySeq | None], ...],
        Field(max_length=2 * _PAIRS_MAX),
        AfterValidator(_are_none_empty),
    ]
    """The most urgent first. An interval without an end goes on with every frame to come."""


class Wanted(Facts):
    """What sessions need: the node keeps it until it is acknowledged, whatever its age."""

    type: Literal["wanted"] = "wanted"
    streams: tuple[StreamNumbers, ...]
    """Not yet sealed, by stream."""
    recording: bool
    """Is a session being recorded, so that a stream that begins now belongs to it from its first
    frame on?"""


class Welcome(Facts):
    """What the server lacks, and what sessions need."""

    type: Literal["welcome"] = "welcome"
    protocol: Count
    lacks: tuple[StreamNumbers, ...]
    """Of the present stream everything that the node has and the server has not, of earlier ones
    what sessions need. The present stream's last interval has no end."""
    wanted: Wanted


class Ack(Facts):
    """These frames are on the server's disk: the node may forget them."""

    type: Literal["ack"] = "ack"
    boot_id: BootId
    seq_first: Seq
    seq_last: Seq

    @model_validator(mode="after")
    def _is_not_empty(self) -> Self:
        if self.seq_last < self.seq_first:
            raise ValueError("the interval is empty")
        return self


class FramesOf(Facts):
    """The frames that follow are of this stream."""

    type: Literal["stream"] = "stream"
    boot_id: BootId


class Probe(Facts):
    """Asks for the server's clock; comes back with it."""

    type: Literal["probe"] = "probe"
    id: Seq
    server_t_ns: TNs | None = None
    """The server's UTC; None on the way there."""


class ClockRow(Facts):
    """The best of eight probes. An offset that was not measured is not sent."""

    type: Literal["clock"] = "clock"
    t_mono_ns: TMonoNs
    server_minus_node_ns: OffsetNs
    """The server's UTC minus the `t_ns` that a frame taken now would have."""
    uncertainty_ns: Annotated[int, Field(ge=0, le=UNCERTAINTY_MAX_NS)]
    """Half the round trip: the server's reading lies somewhere in it."""


class Lost(Facts):
    """All that the node has lost of its present stream so far; sent whenever that changes."""

    type: Literal["lost"] = "lost"
    boot_id: BootId
    lost: PairsByReason


class Status(Facts):
    """What the node counts beside its frames; each second."""

    type: Literal["status"] = "status"
    missed_slots: Count
    backlog_frames: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Frames that the server lacks and the node has; they are sent after the newest ones."""
    troubles: Annotated[tuple[Text, ...], Field(max_length=_TROUBLES_MAX)] = ()
    """What is wrong with the array or with the node's disk now, in words."""
    counts: Annotated[
        dict[Label, Annotated[dict[Label, Count], Field(max_length=_REASONS_MAX)]],
        Field(max_length=_TROUBLES_MAX),
    ] = Field(default={})
    """How often what went wrong in this stream, by serial and reason."""


SaidByNode = Identify | Proof | Hello | FramesOf | Probe | ClockRow | Status | Lost
SaidByServer = Challenge | Welcome | Ack | Wanted | Probe
FromNode: TypeAdapter[SaidByNode] = TypeAdapter(Annotated[SaidByNode, Field(discriminator="type")])
FromServer: TypeAdapter[SaidByServer] = TypeAdapter(
    Annotated[SaidByServer, Field(discriminator="type")]
)


def understood(messages: TypeAdapter[_T], text: str) -> _T:
    """A message of one side; it can be written down, and read back as the same.

    Args:
        messages: `FromNode` or `FromServer`.
        text: without its checksum.

    Raises:
        LinkError: it is no such message, or holds what cannot be.
    """
    try:
        # Strict: true is not 1, and "1" neither.
        return messages.validate_json(text, strict=True)
    except ValidationError as error:
        complaint = error.errors(include_url=False, include_input=False, include_context=False)[0]
        where = ".".join(str(part) for part in complaint["loc"])
        raise LinkError(f"message not understood: {where}: {complaint['msg']}") from error


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
    """A reason as a close frame and a log can carry it: 123 bytes (RFC 6455 5.5) in one line."""
    text = without_folders(text)
    plain = "".join(char if char.isprintable() else "?" for char in text[:_REASON_BYTES_MAX])
    return plain.encode()[:_REASON_BYTES_MAX].decode(errors="ignore")
