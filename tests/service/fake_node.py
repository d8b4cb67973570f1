"""A scripted node at the other end of the link, whose counts are newtons."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from devices.clock import server_utc_ns
from devices.flags import FrameFlag
from devices.frames import ArrayInfo, FrameBatch
from service.estimation.calibration import Calibration
from service.protocol.codec import append_crc, append_text_crc, strip_text_crc
from service.protocol.link import (
    INGEST_PATH,
    PROTOCOL,
    SERVER_MESSAGES,
    Challenge,
    ClockSample,
    EarlierStream,
    Hello,
    Identify,
    Proof,
    RetentionMessage,
    StreamSelect,
    generate_secret,
    make_proof,
)
from storage.intervals import Intervals
from storage.schema import wire_schema
from storage.wire import encode_frames
from tests.builders.arrays import PERIOD_NS, UNLOADED_COUNTS, make_array
from tests.builders.calibrations import make_calibration
from tests.builders.frames import make_frames
from tests.builders.hello import make_hello
from tests.service.recording import Recording
from tests.service.running import Running
from tests.waiting import PATIENCE_S, left_s, until

LONG_AGO_NS = 20_000_000_000
"""A node's frames begin so long before now, so that `now=True` is a leap past what was asked."""


def measure_utc_offset_ns() -> int:
    """Server's UTC minus this machine's monotonic clock: of several readings the quickest.

    A busy machine may stop a thread between the readings of two clocks for a third of a second.
    """
    readings = []
    for _ in range(9):
        before_ns = time.monotonic_ns()
        t_ns = server_utc_ns()
        after_ns = time.monotonic_ns()
        readings.append((after_ns - before_ns, t_ns - (before_ns + after_ns) // 2))
    return min(readings)[1]


@dataclass
class Earlier:
    """A stream that a node took before it was switched on anew."""

    info: ArrayInfo
    next_seq: int
    sent: list[FrameBatch]

    @property
    def stream_id(self) -> str:
        return self.info.stream_id

    def said(self, **changes: Any) -> EarlierStream:
        """As a hello mentions it: the node has all of it."""
        content: dict[str, Any] = {
            "array_info": self.info,
            "stored": ((0, self.next_seq - 1),) if self.next_seq else (),
            "next_seq": self.next_seq,
            "t_ns_first": int(self.sent[0].t_ns[0]) if self.sent else 0,
        }
        return EarlierStream(**content | changes)


class Spoken:
    """A node's end of the link: what it sends has its checksum, whatever it is."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket

    def __getattr__(self, name: str) -> Any:
        return getattr(self._socket, name)

    def send(self, message: str | bytes) -> None:
        """Send something, with the checksum that fits it."""
        if isinstance(message, bytes):
            self.send_raw(append_crc(message))
        elif message.endswith("}"):
            self.send_raw(append_text_crc(message))
        else:
            self.send_raw(message)

    def send_raw(self, message: str | bytes) -> None:
        """Send these bytes."""
        self._socket.send(message)

    def recv(self, timeout: float | None = None) -> str:
        """The next message, without its checksum, which has to be right."""
        return strip_text_crc(self._socket.recv(timeout=timeout))


class FakeNode:
    """A node that says what a test has it say."""

    def __init__(
        self,
        running: Running,
        name: str = "bench",
        *,
        calibration: Calibration | str | None = "by hand",
        tiles: int = 2,
        token: str | None = None,
        is_emulated: bool = False,
        secret: str | None = None,
    ) -> None:
        self.running = running
        self.secret: str | None = secret or generate_secret()
        """Shared with every server; None: its disk keeps none."""
        self.is_emulated = is_emulated
        self.name = name
        self.token = token
        self.calibration = calibration
        self.tiles = tiles
        self.nominal_rate_hz = 1e9 / PERIOD_NS
        self.acked = Intervals()
        """Of the present stream."""
        self.acked_of: dict[str, Intervals] = {}
        self.lacks: dict[str, list[tuple[int, int | None]]] = {}
        """What the server asked for at the last connection, by stream."""
        self.wanted: RetentionMessage
        self.stream_id = ""
        self.seq = 0
        self.sent: list[FrameBatch] = []
        self.before: list[Earlier] = []
        """Its streams before the present one."""
        self.socket: Spoken
        self._sockets = contextlib.ExitStack()
        self.reboot()

    def reboot(self) -> None:
        """Begin a new stream, with the clock where it was before or long ago."""
        if self.stream_id:
            self.before.append(Earlier(self.info, self.seq, self.sent))
        self.stream_id = uuid.uuid4().hex
        self.utc_offset_ns = measure_utc_offset_ns()
        self.next_t_mono_ns = time.monotonic_ns() - LONG_AGO_NS
        self.seq = 0
        self.sent = []
        self.acked = Intervals()

    @property
    def info(self) -> ArrayInfo:
        return make_array(
            self.tiles,
            node=self.name,
            stream_id=self.stream_id,
            utc_offset_ns=self.utc_offset_ns,
            nominal_rate_hz=self.nominal_rate_hz,
        )

    def hello(self, **changes: Any) -> Hello:
        calibration: Any = self.calibration
        if calibration == "by hand":
            calibration = make_calibration(*self.info.serials)
        content: dict[str, Any] = {
            "array_info": self.info,
            "calibration": calibration,
            "stored": ((0, self.seq - 1),) if self.seq else (),
            "next_seq": self.seq,
            "t_mono_ns": time.monotonic_ns(),
            "t_ns_first": int(self.sent[0].t_ns[0]) if self.sent else 0,
            "emulated": self.is_emulated,
        }
        return make_hello(**(content | changes))

    def connect(self, **changes: Any) -> list[tuple[int, int | None]]:
        """Connect and say hello, then how the clocks differ; gives what the server lacks."""
        lacks = self.greet(**changes)
        self.say_clock(0, uncertainty_ns=9, t_mono_ns=time.monotonic_ns())
        return lacks

    def greet(self, **changes: Any) -> list[tuple[int, int | None]]:
        """As `connect`, without a word about clocks."""
        self.open_with_hello(**changes)
        welcome = self.receive("welcome")
        self.wanted = welcome.retention
        self.lacks = {each.stream_id: [*each.numbers] for each in welcome.missing}
        return self.lacks[self.stream_id]

    def say_clock(
        self, server_minus_node_ns: int, *, uncertainty_ns: int = 7, t_mono_ns: int | None = None
    ) -> None:
        """Tell how the clocks differed at this instant, or at the newest frame."""
        row = ClockSample(
            t_mono_ns=self.next_t_mono_ns if t_mono_ns is None else t_mono_ns,
            server_minus_node_ns=server_minus_node_ns,
            uncertainty_ns=uncertainty_ns,
        )
        self.socket.send(row.model_dump_json())

    def say_lost(self, **lost: list[list[int]]) -> None:
        """Tell which numbers of the present stream are lost, by reason."""
        self.socket.send(json.dumps({"type": "lost", "stream_id": self.stream_id, "lost": lost}))

    def open(self) -> Spoken:
        """Connect and say nothing."""
        headers = {"Authorization": f"Bearer {self.token}"} if self.token else None
        self.socket = Spoken(
            self._sockets.enter_context(
                self.running.socket(INGEST_PATH, additional_headers=headers)
            )
        )
        return self.socket

    def open_and_identify(self, name: str | None = None) -> Challenge:
        """Connect and name a node, by default this one; return the server's challenge."""
        who = Identify(protocol=PROTOCOL, node=self.name if name is None else name)
        self.open().send(who.model_dump_json())
        challenge: Challenge = self.receive("challenge")
        return challenge

    def prove(self, **changes: Any) -> Spoken:
        """Connect and prove who it is, as `open_and_identify` and `proof`."""
        challenge = self.open_and_identify()
        self.socket.send(self.proof(challenge, **changes).model_dump_json())
        return self.socket

    def proof(self, challenge: Challenge, **changes: Any) -> Proof:
        """The answer of a node to a challenge."""
        content: dict[str, Any] = {"secret": self.secret}
        if challenge.is_known and self.secret is not None:
            content = {"proof": make_proof(self.secret, challenge, self.name)}
        return Proof(**content | changes)

    def open_with_hello(self, **changes: Any) -> None:
        """Connect, prove who it is and say hello, which may be refused."""
        self.prove().send(self.hello(**changes).model_dump_json())

    def receive(self, kind: str, timeout_s: float = PATIENCE_S) -> Any:
        """The next message of a kind; acknowledgements on the way are noted."""
        end_s = time.monotonic() + timeout_s
        while True:
            message = SERVER_MESSAGES.validate_json(self.socket.recv(timeout=left_s(end_s)))
            if message.type == "ack":
                acked = self.acked_of.setdefault(message.stream_id, Intervals())
                acked.add(message.seq_first, message.seq_last)
                if message.stream_id == self.stream_id:
                    self.acked.add(message.seq_first, message.seq_last)
            if message.type == "retain":
                self.wanted = message
            if message.type == kind:
                return message

    def acknowledged(self, last: int, first: int = 0) -> None:
        """Wait until all of this was acknowledged."""
        end_s = time.monotonic() + PATIENCE_S
        while self.acked.missing_in(first, last):
            self.receive("ack", left_s(end_s))

    def frames(
        self,
        n: int,
        force_n: float | Sequence[float] = 0.0,
        *,
        lead: bool = False,
        now: bool = False,
        noise: int = 0,
        alive: bool = False,
    ) -> FrameBatch:
        """The next `n` frames under a force; `now`: leaping to this instant.

        Readings that are all the same are those of a part that hangs, so at the end of a lead, and
        of frames that are `alive`, one in fifteen is a count higher and the next one lower: the
        mean stays exact.
        """
        if now:
            self.next_t_mono_ns = max(self.next_t_mono_ns, time.monotonic_ns())
        shape = (n, self.tiles)
        t_mono_ns = self.next_t_mono_ns + PERIOD_NS * np.arange(n, dtype=np.int64)
        random = np.random.default_rng(self.seq)
        counts = UNLOADED_COUNTS - np.broadcast_to(np.asarray(force_n), shape)
        counts = counts + random.integers(-noise, noise + 1, shape)
        if lead or alive:
            moved = np.arange(-15, -min(n, 100), -15)
            counts[moved] += 1
            counts[moved + 1] -= 1
        batch = make_frames(
            np.arange(self.seq, self.seq + n),
            self.tiles,
            utc_offset_ns=self.utc_offset_ns,
            t_mono_ns=t_mono_ns,
            pressure_raw=counts,
            sample_offset_us=np.arange(self.tiles),
            frame_flags=FrameFlag.LEAD if lead else 0,
        )
        self.seq += n
        self.next_t_mono_ns += n * PERIOD_NS
        self.sent.append(batch)
        return batch

    def send(self, n: int, force_n: float | Sequence[float] = 0.0, **how: Any) -> FrameBatch:
        """Take frames, and send them ten in a message as nodes do."""
        batch = self.frames(n, force_n, **how)
        self.send_again(batch)
        return batch

    def send_again(self, batch: FrameBatch) -> None:
        """Send frames, perhaps for the second time."""
        for begin in range(0, len(batch), 10):
            self.socket.send(self.payload(batch.slice_rows(begin, begin + 10)))

    def come_back(self) -> list[Earlier]:
        """Connect, mention every earlier stream, and send what the server lacks of them."""
        self.connect(earlier=tuple(earlier.said() for earlier in self.before))
        self.send_lacking()
        return self.before

    def send_lacking(self) -> None:
        """Send what the server asked for of streams before this one."""
        for earlier in self.before:
            for first, last in self.lacks.get(earlier.stream_id, []):
                self.send_earlier(earlier, first, earlier.next_seq - 1 if last is None else last)

    def send_earlier(self, stream: Earlier, seq_first: int, seq_last: int) -> None:
        """Send frames of a stream before this one, then go on with this one."""
        self.socket.send(StreamSelect(stream_id=stream.info.stream_id).model_dump_json())
        rows = FrameBatch.concatenate(stream.sent).slice_rows(seq_first, seq_last + 1)
        for begin in range(0, len(rows), 10):
            batch = rows.slice_rows(begin, begin + 10)
            self.socket.send(encode_frames(batch, wire_schema(stream.info)))
        self.socket.send(StreamSelect(stream_id=self.stream_id).model_dump_json())

    def payload(self, batch: FrameBatch) -> bytes:
        return encode_frames(batch, wire_schema(self.info))

    def all_sent(self) -> FrameBatch:
        """Every frame of this stream, in order."""
        return FrameBatch.concatenate(self.sent)

    def deliver(self, n: int, force_n: float | Sequence[float] = 0.0, **how: Any) -> FrameBatch:
        """Take frames and send them, and wait until they are acknowledged."""
        batch = self.send(n, force_n, **how)
        self.acknowledged(int(batch.seq[-1]), first=int(batch.seq[0]))
        return batch

    def record(self, **body: object) -> Recording:
        """Begin a session of this node."""
        return self.running.record(self.name, **body)

    def taken_in(self) -> None:
        """Wait until the server has the newest frame, be it on its disk or not."""
        until(lambda: self.running.node(self.name)["last_seq"] == self.seq - 1)

    def record_sealed(
        self, n: int, force_n: float | Sequence[float] = 0.0, **how: Any
    ) -> Recording:
        """Record some frames, and seal the session."""
        recording = self.record()
        self.deliver(n, force_n, **how)
        self.finish(recording)
        return recording

    def finish(self, recording: Recording) -> dict[str, Any]:
        """Stop a session, send frames of after the stop, and wait until it is sealed.

        Frames sent in a burst are ahead of real time: the stop waits until it lies behind them.
        """
        until(lambda: time.monotonic_ns() > self.next_t_mono_ns)
        recording.stop()
        self.send(10, now=True)
        return recording.sealed()

    def tared(self) -> FrameBatch:
        """Send a lead that the server tares from."""
        lead = self.send(60, lead=True)
        self.send(10)
        until(lambda: self.running.node(self.name)["tare"])
        return lead

    def leave(self) -> None:
        """Go away, and wait until the server has seen it."""
        self.socket.close()
        until(lambda: not self.running.node(self.name)["connected"])

    def restart(self) -> None:
        """Go away, and be switched on again with a new stream."""
        self.leave()
        self.reboot()

    def close(self) -> None:
        self._sockets.close()


NodeOf = Callable[..., FakeNode]


class Play:
    """A node that streams until it is told to stop.

    It streams in real time, or goes on from its last frame, so many times faster until then.
    """

    def __init__(
        self,
        node: FakeNode,
        force_n: float | Sequence[float] = 0.0,
        *,
        alive: bool = False,
        catch_up: int | None = None,
    ) -> None:
        self.node = node
        self.force_n = force_n
        self.alive = alive
        self.catch_up = catch_up
        self.problem: BaseException | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="play")

    def __enter__(self) -> Play:
        if self.catch_up is None:
            self.node.next_t_mono_ns = time.monotonic_ns()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        if self.problem is not None:  # pytest shows it beside a failure
            sys.stderr.write(f"node {self.node.name} ended: {self.problem!r}\n")

    def _run(self) -> None:
        try:
            # Alive, enough at once that some of them move.
            every_s = 0.05 if self.alive else 0.02
            while not self._stop.wait(every_s):
                due = (time.monotonic_ns() - self.node.next_t_mono_ns) // PERIOD_NS
                if self.catch_up is not None:
                    due = min(due, round(1e9 * self.catch_up * every_s / PERIOD_NS))
                if due > 0:
                    self.node.send(int(due), self.force_n, alive=self.alive)
        except ConnectionClosed as end:
            self.problem = end
