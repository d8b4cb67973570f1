"""A real server on a real socket, and a scripted node whose counts are newtons.

Its chips have b1 = -2 and neither b2 nor c12, so a count is 130/1023 kPa (data sheet eq. 1 and 2),
and its calibration says that 130/1023 kPa are one newton. Unloaded, every tile reads 500 counts.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import subprocess
import sys
import threading
import time
import uuid
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

import service.server
import service.server.recorder
from devices.frames import (
    NO_SERVO_AGE,
    NO_SERVO_COUNTS,
    ArrayInfo,
    FrameBatch,
    FrameStatus,
    TileInfo,
)
from service.api.app import make_app
from service.api.serve import listen, serving, urls_of
from service.estimation.calibration import Calibration, TileCalibration
from service.link import (
    INGEST_PATH,
    PROTOCOL,
    SUBPROTOCOL,
    ClockRow,
    EarlierStream,
    FramesOf,
    FromServer,
    Hello,
    Wanted,
    heard,
    with_check,
)
from service.server.server import Server
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.schema import wire_schema
from storage.wire import encode

COUNT_KPA = 130 / 1023
UNLOADED_COUNTS = 500
UNLOADED_KPA = 787 * 65 / 1023 + 50
NEWTON_CHIP = (1787 * 8, 0xC000, 0, 0)
PERIOD_NS = 2_000_000
TILES = 2
TICK_S = 0.02
LONG_AGO_NS = 20_000_000_000
"""A node's frames begin so long before now, so that `now=True` is a leap past what was asked."""

T = TypeVar("T")


def wait_until(condition: Callable[[], T], timeout_s: float = 8.0) -> T:
    """What `condition` gives, as soon as that is true."""
    end_s = time.monotonic() + timeout_s
    while not (found := condition()):
        if time.monotonic() > end_s:
            pytest.fail(f"not true within {timeout_s} s; last: {found!r}", pytrace=True)
        time.sleep(0.005)
    return found


def newton_calibration(serials: Sequence[str], *, name: str = "by hand") -> Calibration:
    tiles = tuple(
        TileCalibration(
            serial=serial,
            p_input="gauge_kpa",
            p_offset_kpa=0.0,
            p_scale_kpa=COUNT_KPA,
            f_offset_n=0.0,
            f_scale_n=1.0,
            zero_mode="subtract_f0",
            coefficients=(0.0, 1.0, 0.0, 0.0),
            range_kpa=(0.0, 150 * COUNT_KPA),
            monotonic=True,
            absolute_scale="measured",
            covariance=((0.0,) * 3,) * 3,
            relative_misfit=0.0,
            loop_misfit_n=0.0,
            r2=None,
            rmse_n=None,
            cv_rmse_n=None,
            hysteresis_n=None,
            repeats=4,
            baseline_kpa=UNLOADED_KPA,
            noise_kpa=COUNT_KPA,
        )
        for serial in serials
    )
    return Calibration(name=name, reference="none", date="2020-01-01", tiles=tiles)


def array_info(name: str, boot_id: str, utc_offset_ns: int, tiles: int = TILES) -> ArrayInfo:
    return ArrayInfo(
        node=name,
        boot_id=boot_id,
        tiles=tuple(
            TileInfo(
                serial=f"T{i + 1:02}",
                mux=0x70,
                channel=i,
                coefficient_words=NEWTON_CHIP,
                x_m=0.014 * i,
                y_m=0.0,
                z_m=-0.15,
                reference=False,
                conversion_ms=1.6,
            )
            for i in range(tiles)
        ),
        servo=None,
        schedule="simultaneous",
        nominal_rate_hz=1e9 / PERIOD_NS,
        utc_offset_ns=utc_offset_ns,
        clock_set=True,
        software="test",
        scene="test",
        models=("unwrap", "static"),
    )


class Running:
    """A server in a thread with an event loop of its own."""

    def __init__(self, data: Path, *, token: str | None = None, hosts: Sequence[str] = ()) -> None:
        self.data = data
        self.server: Server
        self.http: httpx.Client
        self.port = 0
        self._token = token
        self._hosts = tuple(hosts)
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop
        self._stop: asyncio.Event
        self._problem: BaseException | None = None
        self.open_journals: list[Path] = []
        """Journals that the server left open when it ended."""
        self._left_over: list[str] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> None:
        assert self._thread is None
        ready = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(ready,), name="server")
        self._thread.start()
        assert ready.wait(10.0)
        if self._problem is not None:
            self._thread.join()
            self._thread = None
            raise self._problem
        self.http = httpx.Client(base_url=self.url + "/api/v1", timeout=10.0, trust_env=False)

    def stop(self) -> None:
        if self._thread is None:
            return
        self.http.close()
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(15.0)
        assert not self._thread.is_alive(), "the server does not end"
        self._thread = None
        assert not self._left_over, self._left_over
        if self._problem is not None:
            raise self._problem

    def restart(self) -> None:
        """Stop, and start again on the same port and folder."""
        self.stop()
        self.start()

    def call(self, function: Callable[[], T]) -> T:
        """Run a function in the server's loop."""

        async def run() -> T:
            return function()

        return asyncio.run_coroutine_threadsafe(run(), self._loop).result(10.0)

    def socket(self, path: str, *, small: bool = False, **options: Any) -> ClientConnection:
        """A websocket to the server."""
        options.setdefault("subprotocols", [SUBPROTOCOL])
        if not small:
            options.setdefault("max_queue", None)
        return connect(
            self.url.replace("http", "ws") + path,
            proxy=None,
            compression=None,
            ping_interval=None,
            close_timeout=2.0,
            **options,
        )

    def node(self, name: str = "bench") -> dict[str, Any]:
        answer = self.http.get(f"/nodes/{name}")
        assert answer.status_code == 200, answer.text
        content: dict[str, Any] = answer.json()
        return content

    def session(self, session_id: str) -> dict[str, Any]:
        answer = self.http.get(f"/sessions/{session_id}")
        assert answer.status_code == 200, answer.text
        content: dict[str, Any] = answer.json()
        return content

    def sealed(self, session_id: str) -> dict[str, Any]:
        """The session once it is sealed."""

        def found() -> dict[str, Any] | None:
            session = self.session(session_id)
            return session if session["state"] == "sealed" else None

        session = wait_until(found)
        assert session is not None
        return session

    def journal(self, boot_id: str, name: str = "bench") -> Journal:
        """A journal as another process would find it now: opened from a copy of its files."""
        copy = self.data.with_name(f"copy-{uuid.uuid4().hex}")
        shutil.copytree(self.data / "journal" / name / boot_id, copy)
        return Journal.open(copy)

    def _run(self, ready: threading.Event) -> None:
        try:
            asyncio.run(self._serve(ready))
        except BaseException as error:
            self._problem = error
        finally:
            ready.set()

    async def _serve(self, ready: threading.Event) -> None:
        self._loop = asyncio.get_running_loop()
        self._stop = asyncio.Event()
        with listen("127.0.0.1", self.port) as listening:
            self.server = Server(self.data)
            app = make_app(self.server, hosts=self._hosts, token=self._token)
            async with serving(app, listening):
                self.port = int(urls_of(listening, "127.0.0.1")[-1].rsplit(":", 1)[1])
                ready.set()
                await self._stop.wait()
        self.open_journals = []
        for node in self.server.nodes:
            for journal in node.journals.values():
                if journal._open:
                    self.open_journals.append(journal.folder)
                    journal.close()
        self._left_over = await _left_over()


async def _left_over() -> list[str]:
    """Tasks that go on although everything has ended."""
    end_s = time.monotonic() + 3.0
    while True:
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        if not tasks or time.monotonic() > end_s:
            return [repr(task) for task in tasks]
        await asyncio.sleep(0.01)


@dataclass
class Earlier:
    """A stream that a node took before it was switched on anew."""

    info: ArrayInfo
    next_seq: int
    sent: list[FrameBatch]

    @property
    def boot_id(self) -> str:
        return self.info.boot_id

    def said(self, **changes: Any) -> EarlierStream:
        """As a hello mentions it: the node has all of it."""
        content: dict[str, Any] = {
            "array_info": self.info,
            "held": ((0, self.next_seq - 1),) if self.next_seq else (),
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
            self.send_raw(with_check(message))
        elif message.endswith("}"):
            body = message[:-1]
            self.send_raw(f'{body},"crc32":"{zlib.crc32(body.encode()):08x}"}}')
        else:
            self.send_raw(message)

    def send_raw(self, message: str | bytes) -> None:
        """Send these bytes."""
        self._socket.send(message)

    def recv(self, timeout: float | None = None) -> str:
        """The next message, without its checksum, which has to be right."""
        return heard(self._socket.recv(timeout=timeout))


class FakeNode:
    """A node that says what a test has it say."""

    def __init__(
        self,
        running: Running,
        name: str = "bench",
        *,
        calibration: Calibration | str | None = "by hand",
        tiles: int = TILES,
        token: str | None = None,
    ) -> None:
        self.running = running
        self.name = name
        self.token = token
        self.calibration = calibration
        self.tiles = tiles
        self.acked = Intervals()
        """Of the present stream."""
        self.acked_of: dict[str, Intervals] = {}
        self.lacks: dict[str, list[tuple[int, int | None]]] = {}
        """What the server asked for at the last connection, by stream."""
        self.wanted: Wanted | None = None
        self.boot_id = ""
        self.before: list[Earlier] = []
        """Its streams before the present one."""
        self.socket: Spoken
        self._sockets = contextlib.ExitStack()
        self.reboot()

    def reboot(self) -> None:
        """Begin a new stream, with the clock where it was before or long ago."""
        if self.boot_id:
            self.before.append(Earlier(self.info, self.seq, self.sent))
        self.boot_id = uuid.uuid4().hex
        self.utc_offset_ns = time.time_ns() - time.monotonic_ns()
        self.next_t_mono_ns = time.monotonic_ns() - LONG_AGO_NS
        self.seq = 0
        self.sent: list[FrameBatch] = []
        self.acked = Intervals()

    @property
    def info(self) -> ArrayInfo:
        return array_info(self.name, self.boot_id, self.utc_offset_ns, self.tiles)

    def hello(self, **changes: Any) -> Hello:
        calibration: Any = self.calibration
        if calibration == "by hand":
            calibration = newton_calibration(self.info.serials)
        content: dict[str, Any] = {
            "protocol": PROTOCOL,
            "array_info": self.info,
            "held": ((0, self.seq - 1),) if self.seq else (),
            "next_seq": self.seq,
            "scene": {"name": "test"},
            "emulated": False,
            "calibration": calibration,
            "calibration_problem": None if calibration else "for this test",
        }
        return Hello(**(content | changes))

    def connect(self, **changes: Any) -> list[tuple[int, int | None]]:
        """Connect and say hello, then how the clocks differ; gives what the server lacks."""
        self.open()
        self.socket.send(self.hello(**changes).model_dump_json())
        welcome = self.receive("welcome")
        self.wanted = welcome.wanted
        self.lacks = {each.boot_id: [*each.numbers] for each in welcome.lacks}
        clock = ClockRow(t_mono_ns=time.monotonic_ns(), server_minus_node_ns=0, uncertainty_ns=9)
        self.socket.send(clock.model_dump_json())
        return self.lacks[self.boot_id]

    def open(self) -> Spoken:
        """Connect and say nothing."""
        headers = {"Authorization": f"Bearer {self.token}"} if self.token else None
        self.socket = Spoken(
            self._sockets.enter_context(
                self.running.socket(INGEST_PATH, additional_headers=headers)
            )
        )
        return self.socket

    def receive(self, kind: str, timeout_s: float = 8.0) -> Any:
        """The next message of a kind; acknowledgements on the way are noted."""
        end_s = time.monotonic() + timeout_s
        while True:
            message = FromServer.validate_json(
                self.socket.recv(timeout=max(0.0, end_s - time.monotonic()))
            )
            if message.type == "ack":
                acked = self.acked_of.setdefault(message.boot_id, Intervals())
                acked.add(message.seq_first, message.seq_last)
                if message.boot_id == self.boot_id:
                    self.acked.add(message.seq_first, message.seq_last)
            if message.type == "wanted":
                self.wanted = message
            if message.type == kind:
                return message

    def acknowledged(self, last: int, first: int = 0) -> None:
        """Wait until all of this was acknowledged."""
        while self.acked.missing(first, last):
            self.receive("ack")

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

        Readings that are all the same are those of a part that hangs, so in a lead, and in frames
        that are `alive`, one is a count higher and one a count lower: the mean stays exact.
        """
        if now:
            self.next_t_mono_ns = max(self.next_t_mono_ns, time.monotonic_ns())
        shape = (n, self.tiles)
        t_mono_ns = self.next_t_mono_ns + PERIOD_NS * np.arange(n, dtype=np.int64)
        random = np.random.default_rng(self.seq)
        counts = UNLOADED_COUNTS - np.broadcast_to(np.asarray(force_n), shape)
        counts = counts + random.integers(-noise, noise + 1, shape)
        if lead or alive:
            counts[-30:-28] += [[1], [-1]]
        batch = FrameBatch(
            seq=np.arange(self.seq, self.seq + n, dtype=np.uint64),
            t_mono_ns=t_mono_ns,
            t_ns=t_mono_ns + self.utc_offset_ns,
            padc=counts.astype(np.uint16),
            tadc=np.full(shape, 480, dtype=np.uint16),
            sample_offset_us=np.broadcast_to(np.arange(self.tiles, dtype=np.int32), shape).copy(),
            servo_counts=np.full(n, NO_SERVO_COUNTS, dtype=np.int32),
            servo_age_us=np.full(n, NO_SERVO_AGE, dtype=np.int32),
            status=np.zeros(shape, dtype=np.uint8),
            frame_status=np.full(n, FrameStatus.LEAD if lead else 0, dtype=np.uint8),
            reference_force_n=np.full(n, np.nan, dtype=np.float32),
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
            self.socket.send(self.payload(batch.rows(begin, begin + 10)))

    def send_earlier(self, stream: Earlier, seq_first: int, seq_last: int) -> None:
        """Send frames of a stream before this one, then go on with this one."""
        self.socket.send(FramesOf(boot_id=stream.info.boot_id).model_dump_json())
        rows = FrameBatch.concatenate(stream.sent).rows(seq_first, seq_last + 1)
        for begin in range(0, len(rows), 10):
            batch = rows.rows(begin, begin + 10)
            self.socket.send(encode(batch, wire_schema(stream.info)))
        self.socket.send(FramesOf(boot_id=self.boot_id).model_dump_json())

    def payload(self, batch: FrameBatch) -> bytes:
        return encode(batch, wire_schema(self.info))

    def all_sent(self) -> FrameBatch:
        """Every frame of this stream, in order."""
        return FrameBatch.concatenate(self.sent)

    def tared(self) -> FrameBatch:
        """Connect if need be, and send a lead that the server tares from."""
        lead = self.send(60, lead=True)
        self.send(10)
        wait_until(lambda: self.running.node(self.name)["tare"])
        return lead

    def leave(self) -> None:
        """Go away, and wait until the server has seen it."""
        self.socket.close()
        wait_until(lambda: not self.running.node(self.name)["connected"])

    def close(self) -> None:
        self._sockets.close()


class Play:
    """A node that streams in real time until it is told to stop."""

    def __init__(self, node: FakeNode, force_n: float = 0.0) -> None:
        self.node = node
        self.force_n = force_n
        self.problem: BaseException | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="play")

    def __enter__(self) -> Play:
        self.node.next_t_mono_ns = time.monotonic_ns()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5.0)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        try:
            while not self._stop.wait(0.02):
                due = (time.monotonic_ns() - self.node.next_t_mono_ns) // PERIOD_NS
                if due > 0:
                    self.node.send(int(due), self.force_n)
        except ConnectionClosed as end:
            self.problem = end


class Process:
    """`foottile` as a process; its output is read as it comes."""

    def __init__(self, *arguments: object, folder: Path, **environment: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        # The package is found by where it is installed, not by the working directory.
        self.process = subprocess.Popen(
            [str(Path(sys.executable).parent / "foottile"), *map(str, arguments)],
            cwd=folder,
            env={
                **os.environ,
                "COLUMNS": "200",
                "PYTHONUNBUFFERED": "1",
                "XDG_STATE_HOME": str(folder.parent / "state"),  # journals of nodes
                **environment,
            },
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.out: list[str] = []
        self.err: list[str] = []
        self._readers = [
            threading.Thread(target=self._read, args=(stream, lines), name="reader")
            for stream, lines in (
                (self.process.stdout, self.out),
                (self.process.stderr, self.err),
            )
        ]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        return self.process.pid

    def said(self, text: str, timeout_s: float = 20.0) -> str:
        """The first line of either stream with this text."""

        def found() -> str | None:
            lines = [line for line in (*self.out, *self.err) if text in line]
            if not lines and self.process.poll() is not None:
                pytest.fail(f"ended with {self.process.returncode}: {self.out} {self.err}")
            return lines[0] if lines else None

        line = wait_until(found, timeout_s)
        assert line is not None
        return line

    def ended(self, timeout_s: float) -> int:
        """Its exit code, once it has ended."""
        code = self.process.wait(timeout_s)
        for reader in self._readers:
            reader.join(10.0)
        return code

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(5.0)
        for reader, stream in zip(
            self._readers, (self.process.stdout, self.process.stderr), strict=True
        ):
            reader.join(5.0)
            assert stream is not None
            stream.close()

    def _read(self, stream: Any, lines: list[str]) -> None:
        with contextlib.suppress(ValueError):  # closed
            lines.extend(line.rstrip("\n") for line in iter(stream.readline, ""))


@pytest.fixture(scope="session")
def array_of() -> Callable[..., ArrayInfo]:
    """An array of this name, stream and offset to UTC."""
    return array_info


@pytest.fixture(scope="session")
def newtons_of() -> Callable[..., Calibration]:
    """A calibration of one newton a count for these serials."""
    return newton_calibration


@pytest.fixture
def no_threads_left() -> Iterator[None]:
    """Fail if a thread outlives what a test has started."""
    before = set(threading.enumerate())
    yield

    def left() -> list[threading.Thread]:
        return [thread for thread in threading.enumerate() if thread not in before]

    wait_until(lambda: not left(), 5.0)


@pytest.fixture
def serve_with(
    no_threads_left: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Running]]:
    """A server with this token and these names; its ticks are quick, and so the tests are."""
    monkeypatch.setattr(service.server.server, "TICK_S", TICK_S)
    monkeypatch.setattr(service.server.recorder, "BEHIND_S", 1e9)  # its frames are long ago
    started: list[Running] = []

    def start(**options: Any) -> Running:
        running = Running(tmp_path / f"data-{len(started)}", **options)
        started.append(running)
        running.start()
        return running

    yield start
    for running in started:
        running.stop()


@pytest.fixture
def running(serve_with: Callable[..., Running]) -> Running:
    """A server on loopback."""
    return serve_with()


@pytest.fixture
def node_of(no_threads_left: None) -> Iterator[Callable[..., FakeNode]]:
    """A fake node of a server, not yet connected."""
    nodes: list[FakeNode] = []

    def make(running: Running, *arguments: Any, **options: Any) -> FakeNode:
        nodes.append(FakeNode(running, *arguments, **options))
        return nodes[-1]

    yield make
    for node in nodes:
        node.close()


@pytest.fixture
def node(running: Running, node_of: Callable[..., FakeNode]) -> FakeNode:
    """A fake node, not yet connected."""
    return node_of(running)


@pytest.fixture
def play() -> Callable[..., Play]:
    """Have a node stream while a block runs."""
    return Play


@pytest.fixture
def until() -> Callable[..., Any]:
    """Wait for a condition."""
    return wait_until


@pytest.fixture
def closing() -> Callable[[ClientConnection], tuple[int, str]]:
    """Code and reason with which the server closes a websocket."""

    def wait(socket: ClientConnection, timeout_s: float = 5.0) -> tuple[int, str]:
        try:
            while True:
                socket.recv(timeout=timeout_s)
        except ConnectionClosed as end:
            if end.rcvd is None:
                pytest.fail("it was cut off without a close frame")
            return int(end.rcvd.code), end.rcvd.reason

    return wait


@pytest.fixture
def foottile(no_threads_left: None, tmp_path: Path) -> Iterator[Callable[..., Process]]:
    """Start `foottile` as a process."""
    processes: list[Process] = []

    def start(*arguments: object, **environment: str) -> Process:
        processes.append(Process(*arguments, folder=tmp_path / "cwd", **environment))
        return processes[-1]

    yield start
    for process in processes:
        process.close()
