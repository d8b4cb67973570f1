"""Messages between node and server, `foottile.v1`.

node                                  server
    identify (its name)              -->
                                     <--  challenge (a nonce)
    proof, hello (stored frames)     -->
                                     <--  welcome (missing frames, retention request)
    stream, then Arrow messages      -->
                                     <--  ack (frames on the server's disk)
                                     <--  retain (retention request)
    probe                            <->  probe        eight at a time, for the clocks' offset
    clock, status, lost              -->

Text messages are JSON with a `type`; a binary message is a record batch (`storage.wire`) of the
stream named last. The newest frames are sent first; older frames that the server misses, of this
stream and of earlier ones, follow. The node retains all frames that a session needs until they are
acknowledged; a new connection begins with identify again. Frames may arrive twice and in any order:
a server stores each (stream, seq) once.

A node proves that it is the machine that had its name before (HMAC challenge-response). Stream ids
are public: every viewer reads them at `GET /nodes`. So each node shares a secret with each server.
At first contact the node creates it and stores it on disk before it sends it; the server stores it
before it answers with welcome. Afterwards only a proof is sent (`make_proof`), with a nonce of the
connection. Only a person may replace a secret.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import math
import re
import secrets
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, TypeAdapter, model_validator

from devices.chips.pressure_chips import KnownArray
from devices.types import (
    Count,
    Identifier,
    OffsetNs,
    Seq,
    StrictModel,
    Text,
    TMonoNs,
    TNs,
    check_text,
)
from devices.vitals import Vitals
from service.estimation.calibration import Calibration
from storage.intervals import NO_END

SCENE_BYTES_MAX = 256 << 10
_DEPTH_MAX = 16
_KEY_LENGTH_MAX = 200
_INTEGER_END = 2**63


def _check_bounds(content: dict[str, Any]) -> dict[str, Any]:
    _check_value(content, 0)
    if len(json.dumps(content)) > SCENE_BYTES_MAX:
        raise ValueError(f"is longer than {SCENE_BYTES_MAX} bytes")
    return content


def _check_value(value: Any, depth: int) -> None:
    if depth > _DEPTH_MAX:
        raise ValueError(f"is nested more than {_DEPTH_MAX} times")
    if isinstance(value, dict):
        for key, inside in value.items():
            if len(key) > _KEY_LENGTH_MAX:
                raise ValueError(f"has a key of {len(key)} letters")
            check_text(key)
            _check_value(inside, depth + 1)
    elif isinstance(value, list | tuple):
        for inside in value:
            _check_value(inside, depth + 1)
    elif isinstance(value, str):
        check_text(value)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError("has a number that is not finite")
    elif isinstance(value, int) and not -_INTEGER_END <= value < _INTEGER_END:
        raise ValueError("has an integer of more than 64 bits")


SceneContent = Annotated[dict[str, Any], AfterValidator(_check_bounds)]
"""Content of a scene file. Server and sessions only store it, for people and for `foottile node`;
`devices.scene` interprets it."""

SUBPROTOCOL = "foottile.v1"
PROTOCOL = 6
INGEST_PATH = "/api/v1/ingest"
MESSAGE_BYTES_MAX = 1 << 20
"""Longest message that either side accepts. A batch of 64 tiles is 0.1 MB."""
LINK_TIMEOUT_S = 5.0
"""Timeout of the link: a side closes it after receiving nothing for so long."""
PROBES_PER_MEASUREMENT = 8

_INTERVALS_MAX = 1 << 14
"""Most intervals in a list: a gap every ten seconds for two days."""
_STREAMS_MAX = 256
_REQUESTED_STREAMS_MAX = 1 << 14
"""Most streams of a request, about as many as fit into a message."""
_REASONS_MAX = 32
_WARNINGS_MAX = 1000
UNCERTAINTY_MAX_NS = 60_000_000_000
"""Longest round trip, halved, of a usable probe."""
_STREAM_ID = re.compile(r"[0-9a-f]{32}")
_SeqOrEnd = Annotated[int, Field(ge=0, le=NO_END)]
"""Frame number, or the end after the last possible one."""

StreamId = Annotated[str, Field(pattern=f"^{_STREAM_ID.pattern}$")]
"""Id of a stream."""
_Hex256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


def is_stream_id(text: str) -> bool:
    """Return whether a text is an id of a stream: 32 hex digits."""
    return _STREAM_ID.fullmatch(text) is not None


def _check_rising(pairs: tuple[tuple[int, int | None], ...]) -> tuple[tuple[int, int | None], ...]:
    end: int | None = -1
    for first, last in pairs:
        if end is None or first <= end or (last is not None and last < first):
            raise ValueError("intervals must be rising and not empty")
        end = last
    return pairs


def _check_none_empty(
    pairs: tuple[tuple[int, int | None], ...],
) -> tuple[tuple[int, int | None], ...]:
    if any(last is not None and last < first for first, last in pairs):
        raise ValueError("an interval is empty")
    return pairs


SeqIntervals = Annotated[
    tuple[tuple[Seq, Seq], ...], Field(max_length=_INTERVALS_MAX), AfterValidator(_check_rising)
]
"""Frame numbers as closed intervals, in order."""
SeqIntervalsByReason = Annotated[
    dict[Annotated[str, Field(pattern=r"^[a-z_]{1,40}$")], SeqIntervals],
    Field(max_length=_REASONS_MAX),
]


class Identify(StrictModel):
    """First message: name of the connecting node."""

    type: Literal["identify"] = "identify"
    protocol: Count
    node: Identifier


class Challenge(StrictModel):
    """Request for a proof that the node is the machine that had its name before."""

    type: Literal["challenge"] = "challenge"
    protocol: Count
    server_id: Identifier
    """Name of the server's data folder: a node shares one secret with each."""
    nonce: _Hex256
    """Random, for this connection only."""
    is_known: bool
    """True if the server has a secret of this node; else it accepts the secret that the node sends.
    """


class Proof(StrictModel):
    """Answer to `challenge`. A node whose disk cannot store a secret sends neither field."""

    type: Literal["proof"] = "proof"
    proof: _Hex256 | None = None
    """HMAC of the challenge, by `make_proof`."""
    secret: _Hex256 | None = None
    """The secret itself: at first contact, or where a person has to accept this machine."""


class EarlierStream(StrictModel):
    """Ended stream with frames that the node still stores or has lost."""

    array_info: KnownArray
    stored: SeqIntervals
    """Frames stored on the node."""
    next_seq: Seq
    """Number after the last known frame."""
    lost: SeqIntervalsByReason = Field(default={})
    """Frames lost on the node, by reason."""
    max_lost_tail_frames: Count = 0
    """Upper bound of further frames at the end, lost in a power failure. 0: the stream ended in
    order, or its process was killed, which loses no frames."""
    missed_slots: Count = 0
    t_ns_first: TNs = 0
    """Instant of the oldest stored frame, in the node's UTC."""


class Hello(StrictModel):
    """Description of the node and of its streams."""

    type: Literal["hello"] = "hello"
    protocol: Count
    array_info: KnownArray
    stored: SeqIntervals
    """Frames of the present stream stored on the node."""
    next_seq: Seq
    """Number of the next frame."""
    t_mono_ns: TMonoNs
    """CLOCK_MONOTONIC of the node when it composed this message."""
    lost: SeqIntervalsByReason = Field(default={})
    """Lost frames of the present stream, by reason."""
    t_ns_first: TNs = 0
    """Instant of the oldest stored frame of the present stream, in the node's UTC; 0: none."""
    vitals: Vitals | None = None
    """Vitals of its machine; None: not read yet."""
    scene: SceneContent
    """Content of the scene file."""
    emulated: bool
    calibration: Calibration | None
    calibration_problem: Text | None
    """Reason why there is no calibration."""
    earlier: Annotated[tuple[EarlierStream, ...], Field(max_length=_STREAMS_MAX)] = ()
    """Earlier streams, oldest first."""
    has_more: bool = False
    """True if further earlier streams did not fit. They are announced once these are delivered."""


class StreamNumbers(StrictModel):
    """Frame numbers of one stream."""

    stream_id: StreamId
    numbers: Annotated[
        tuple[tuple[_SeqOrEnd, _SeqOrEnd | None], ...],
        Field(max_length=2 * _INTERVALS_MAX),
        AfterValidator(_check_none_empty),
    ]
    """Intervals, the most urgent first. An interval without an end includes all future frames."""


_RequestedStreams = Annotated[tuple[StreamNumbers, ...], Field(max_length=_REQUESTED_STREAMS_MAX)]


class RetentionMessage(StrictModel):
    """Retention request: frames for the node to retain until acknowledged, whatever their age."""

    type: Literal["retain"] = "retain"
    streams: _RequestedStreams
    """Frames of sessions that are not yet sealed, by stream."""
    recording: bool
    """True while a session is being recorded: a new stream belongs to it from its first frame on.
    """


class Welcome(StrictModel):
    """Acceptance of the node, with the frames that the server misses and a retention request."""

    type: Literal["welcome"] = "welcome"
    protocol: Count
    missing: _RequestedStreams
    """Missing frames: of the present stream all that the node stores and the server does not, of
    earlier ones those of sessions. The present stream's last interval has no end."""
    retention: RetentionMessage


class Ack(StrictModel):
    """Acknowledgement that frames are on the server's disk: the node may delete them."""

    type: Literal["ack"] = "ack"
    stream_id: StreamId
    seq_first: Seq
    seq_last: Seq

    @model_validator(mode="after")
    def _is_not_empty(self) -> Self:
        if self.seq_last < self.seq_first:
            raise ValueError("the interval is empty")
        return self


class StreamSelect(StrictModel):
    """Selection of the stream of all following frames."""

    type: Literal["stream"] = "stream"
    stream_id: StreamId


class ClockProbe(StrictModel):
    """Request for the server's clock, and its answer."""

    type: Literal["probe"] = "probe"
    id: Seq
    server_t_ns: TNs | None = None
    """The server's UTC; None in the request."""


class ClockSample(StrictModel):
    """Clock offset by the best of eight probes. A failed measurement is not sent."""

    type: Literal["clock"] = "clock"
    t_mono_ns: TMonoNs
    server_minus_node_ns: OffsetNs
    """The server's UTC minus the `t_ns` of a frame at the same instant."""
    uncertainty_ns: Annotated[int, Field(ge=0, le=UNCERTAINTY_MAX_NS)]
    """Half the round trip, which contains the server's reading."""


class LossReport(StrictModel):
    """All lost frames of a stream; sent whenever they change."""

    type: Literal["lost"] = "lost"
    stream_id: StreamId
    lost: SeqIntervalsByReason


class NodeStatus(StrictModel):
    """Counters and warnings of the node; each second."""

    type: Literal["status"] = "status"
    missed_slots: Count
    backlog_frames: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Backlog: frames still to be sent after the newest ones."""
    warnings: Annotated[tuple[Text, ...], Field(max_length=_WARNINGS_MAX)] = ()
    """Present warnings about the array or the node's disk."""
    counts: Annotated[
        dict[Identifier, Annotated[dict[Identifier, Count], Field(max_length=_REASONS_MAX)]],
        Field(max_length=_WARNINGS_MAX),
    ] = Field(default={})
    """Fault counts of this stream, by serial and reason."""
    vitals: Vitals | None = None
    """Vitals of its machine; None: not read yet."""


NodeMessage = (
    Identify | Proof | Hello | StreamSelect | ClockProbe | ClockSample | NodeStatus | LossReport
)
ServerMessage = Challenge | Welcome | Ack | RetentionMessage | ClockProbe
LinkMessage = NodeMessage | ServerMessage
NODE_MESSAGES: TypeAdapter[NodeMessage] = TypeAdapter(
    Annotated[NodeMessage, Field(discriminator="type")]
)
SERVER_MESSAGES: TypeAdapter[ServerMessage] = TypeAdapter(
    Annotated[ServerMessage, Field(discriminator="type")]
)


_SECRET_BYTES = 32
_FINGERPRINT_GROUPS = 4


def generate_secret() -> str:
    """Generate 32 random bytes as hex digits, for a secret or a nonce."""
    return secrets.token_hex(_SECRET_BYTES)


def make_proof(secret: str, challenge: Challenge, node: str) -> str:
    """Compute the proof that a node has the shared secret: HMAC-SHA-256 in hex digits.

    Args:
        secret: secret of this node and this server.
        challenge: the server's challenge on this connection.
        node: name of the node.
    """
    content = f"{SUBPROTOCOL} {PROTOCOL} {challenge.server_id} {challenge.nonce} {node}"
    return hmac.new(bytes.fromhex(secret), content.encode(), hashlib.sha256).hexdigest()


def is_proof_valid(secret: str, challenge: Challenge, node: str, answer: Proof) -> bool:
    """Return whether an answer proves the secret.

    The secret itself is valid as well: a machine accepted a moment ago may still send it.
    """
    if answer.secret is not None and hmac.compare_digest(answer.secret, secret):
        return True
    right = make_proof(secret, challenge, node)
    return answer.proof is not None and hmac.compare_digest(answer.proof, right)


def compute_fingerprint(secret: str) -> str:
    """Compute a secret's fingerprint for people: 16 hex digits, in groups."""
    digits = hashlib.sha256(bytes.fromhex(secret)).hexdigest()
    return "-".join(digits[4 * i : 4 * i + 4] for i in range(_FINGERPRINT_GROUPS))
