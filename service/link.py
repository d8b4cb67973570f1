"""The link between node and server, `foottile.v1`: what each side says, and why it hangs up.

    node                                  server
    hello (ArrayInfo, what it has)   -->
                                     <--  welcome (what the server lacks)
    Arrow messages, oldest first     -->
                                     <--  ack (what is on the server's disk)
    probe                            <->  probe        eight at a time, for the clocks' offset
    clock, status                    -->

Text messages are JSON with a `type`; a binary message is a record batch (`storage.wire`). The node
forgets nothing that is not acknowledged, and a new connection begins with hello again.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration

SUBPROTOCOL = "foottile.v1"
PROTOCOL = 1
INGEST_PATH = "/api/v1/ingest"
LIVE_PATH = "/api/v1/live"
MESSAGE_BYTES_MAX = 1 << 20
"""Longest message either side takes. A batch of 64 tiles is 0.1 MB."""
SILENCE_S = 5.0
"""A side that has heard nothing for so long takes the link for dead."""
PROBES = 8
_REASON_BYTES_MAX = 123

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


class StreamEnd(_Message):
    """Where a stream of this node ended in order: it was given to the server to its last frame."""

    boot_id: str
    next_seq: _Seq


class Hello(_Message):
    """Who the node is, and what it can give."""

    type: Literal["hello"] = "hello"
    protocol: int
    array_info: ArrayInfo
    first_seq: _Seq
    """The oldest frame it still has."""
    next_seq: _Seq
    """The number of the next frame to be taken."""
    scene: dict[str, Any]
    """The scene file's content."""
    emulated: bool
    calibration: Calibration | None
    calibration_problem: str | None
    """Why there is none."""
    previous: StreamEnd | None = None
    """The stream before, if the node is the same and its array has become another one."""


class Welcome(_Message):
    """What the server lacks of this stream, as closed intervals; the last one has no end."""

    type: Literal["welcome"] = "welcome"
    protocol: int
    lacks: tuple[tuple[_Seq, _Seq | None], ...]


class Ack(_Message):
    """These frames are on the server's disk: the node may forget them."""

    type: Literal["ack"] = "ack"
    seq_first: _Seq
    seq_last: _Seq


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


class Status(_Message):
    """What the node counts beside its frames; each second."""

    type: Literal["status"] = "status"
    missed_slots: Annotated[int, Field(ge=0)]
    first_seq: _Seq
    """The oldest frame it still has; older ones that the server lacks are lost: evicted."""
    troubles: tuple[str, ...] = ()
    """What is wrong with the array now, in words."""
    counts: dict[str, dict[str, Annotated[int, Field(ge=0)]]] = {}
    """How often what went wrong in this stream, by serial and reason."""


FromNode: TypeAdapter[Hello | Probe | ClockRow | Status] = TypeAdapter(
    Annotated[Hello | Probe | ClockRow | Status, Field(discriminator="type")]
)
FromServer: TypeAdapter[Welcome | Ack | Probe] = TypeAdapter(
    Annotated[Welcome | Ack | Probe, Field(discriminator="type")]
)


def close_reason(text: str) -> str:
    """A reason as a close frame can carry it: 123 bytes (RFC 6455 5.5)."""
    return text.encode()[:_REASON_BYTES_MAX].decode(errors="ignore")
