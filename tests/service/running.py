"""A real server on a real socket, in a thread of the test's process."""

from __future__ import annotations

import asyncio
import functools
import json
import shutil
import ssl
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import httpx
import pytest
from pydantic import TypeAdapter
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from devices.frames import FrameBatch
from service.api.access import Logins, Role
from service.api.address import list_urls, open_listening_socket
from service.api.app import make_app, serve_app
from service.api.routes.login import add_ticket
from service.api.settings import LimitSettings
from service.estimation.compilation import compile_models
from service.protocol.link import SUBPROTOCOL
from service.protocol.live import PageMessage
from service.server.server import Server
from storage.journal.journal import Journal
from tests.service.recording import Recording
from tests.tokens import SHARED_BEARER, SHARED_TOKEN
from tests.waiting import PATIENCE_S, left_s

PAGE_MESSAGES: TypeAdapter[PageMessage] = TypeAdapter(PageMessage)
T = TypeVar("T")

_NO_TLS = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
"""For clients that speak plain HTTP: reading the authorities' certificates takes 30 ms a client."""


def assert_refused(answer: httpx.Response, status: int, *words: str) -> None:
    """The answer is a problem with this status, and its detail has all of these words."""
    assert answer.status_code == status, answer.text
    for word in words:
        assert word in answer.json()["detail"]


def content_of(answer: httpx.Response, status: int = 200) -> Any:
    """Check the status of an answer and return its JSON."""
    assert answer.status_code == status, answer.text
    return answer.json()


def receive_live(socket: Any, is_wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """Return the next live message that is wanted; others come all the time."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        text = socket.recv(timeout=left_s(end_s))
        message: dict[str, Any] = json.loads(text)
        PAGE_MESSAGES.validate_json(text, strict=True)
        if is_wanted(message):
            return message


@functools.cache
def _compile_once() -> None:
    """Compile the models, which takes a busy machine minutes: then no test waits for forces."""
    compile_models()


class Running:
    """A server in a thread with an event loop of its own.

    Without a token of the test's own, `http`, sockets and nodes of it show the one that tests
    share. A test that gives a token is about tokens: then each request shows what the test says.
    """

    def __init__(
        self,
        data: Path,
        *,
        token: str | None = None,
        is_private: bool = False,
        hosts: Sequence[str] = (),
        bounds: LimitSettings | None = None,
        unquantized: bool = False,
        context: ssl.SSLContext | None = None,
    ) -> None:
        self.data = data
        self.server: Server
        self.http: httpx.Client
        self.port = 0
        self._token = token if token is not None else SHARED_TOKEN
        self.shown = dict(SHARED_BEARER) if token is None else {}
        """Headers that every request of `http`, socket and node has."""
        self._is_private = is_private
        self.logins: Logins
        self._hosts = tuple(hosts)
        self._bounds = bounds
        self._unquantized = unquantized
        self._context = context
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
        _compile_once()
        ready = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(ready,), name="server")
        self._thread.start()
        assert ready.wait(PATIENCE_S)
        if self._problem is not None:
            self._thread.join(PATIENCE_S)
            self._thread = None
            raise self._problem
        self.http = self.client()

    def client(self) -> httpx.Client:
        """A client of the API."""
        return httpx.Client(
            base_url=self.url + "/api/v1",
            headers=self.shown,
            timeout=PATIENCE_S,
            trust_env=False,
            verify=_NO_TLS,
        )

    def stop(self) -> None:
        if self._thread is None:
            return
        self.http.close()
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(PATIENCE_S)
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

        return asyncio.run_coroutine_threadsafe(run(), self._loop).result(PATIENCE_S)

    def link(self) -> str:
        """An address of the live page that logs a browser in, once."""
        ticket = self.call(lambda: self.logins.tickets.create(Role.OPERATOR))
        return add_ticket(self.url, ticket)

    def socket(self, path: str, *, small: bool = False, **options: Any) -> ClientConnection:
        """A websocket to the server."""
        options.setdefault("subprotocols", [SUBPROTOCOL])
        options["additional_headers"] = self.shown | (options.get("additional_headers") or {})
        if not small:
            options.setdefault("max_queue", None)
        connection: ClientConnection = connect(
            self.url.replace("http", "ws") + path,
            proxy=None,
            compression=None,
            ping_interval=None,
            close_timeout=2.0,
            **options,
        )
        return connection

    def node(self, name: str = "bench") -> dict[str, Any]:
        answer = self.http.get(f"/nodes/{name}")
        assert answer.status_code == 200, answer.text
        content: dict[str, Any] = answer.json()
        return content

    def record(self, node: str = "bench", **body: object) -> Recording:
        """Begin a session."""
        answer = self.http.post("/sessions", json={"node": node, "name": "trial"} | body)
        assert answer.status_code == 201, answer.text
        recording = Recording(self, answer.json())
        assert answer.headers["location"] == f"/api/v1{recording.url}"
        return recording

    def session(self, session_id: str) -> Recording:
        """A session that has begun already."""
        return Recording(self, {"id": session_id})

    def only_session(self, *, but: Recording | None = None) -> Recording:
        """The one session that there is, but for this one."""
        (found,) = [s for s in self.sessions() if but is None or s["id"] != but.id]
        return Recording(self, found)

    def sessions(self) -> list[dict[str, Any]]:
        """Every session that is not in the trash, the newest first."""
        items: list[dict[str, Any]] = self.http.get("/sessions").json()["items"]
        return items

    def journal(self, stream_id: str, name: str = "bench") -> Journal:
        """A journal as another process would find it now: opened from a copy of its files."""
        copy = self.data.with_name(f"copy-{uuid.uuid4().hex}")
        shutil.copytree(self.data / "journal" / name / stream_id, copy)
        return Journal.open_existing_and_recover(copy)

    def held(self, stream_id: str, name: str = "bench") -> FrameBatch:
        """All that its journal holds, in order."""
        return FrameBatch.concatenate(list(self.journal(stream_id, name).read_frames(0, 2**61)))

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
        with open_listening_socket("127.0.0.1", self.port) as listening:
            self.server = Server(self.data, unquantized=self._unquantized)
            if not self.shown or not hasattr(self, "logins"):
                # Where a test is about something else, its pages stay logged in over a restart.
                self.logins = Logins(self._token, is_private=self._is_private)
            app = make_app(self.server, logins=self.logins, hosts=self._hosts)
            async with serve_app(app, listening, self._bounds, self._context):
                self.port = int(list_urls(listening, "127.0.0.1")[-1].rsplit(":", 1)[1])
                ready.set()
                await self._stop.wait()
        self.open_journals = []
        for node in self.server.nodes:
            for journal in (stream.journal for stream in node.streams.values()):
                if journal is not None and journal.has_unclosed_segment:
                    self.open_journals.append(journal.folder)
                    journal.close()
        self._left_over = await _left_over()


ServeWith = Callable[..., Running]


async def _left_over() -> list[str]:
    """Tasks that go on although everything has ended."""
    end_s = time.monotonic() + PATIENCE_S / 2
    while True:
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        if not tasks or time.monotonic() > end_s:
            return [repr(task) for task in tasks]
        await asyncio.sleep(0.01)


def closed(socket: Any, timeout_s: float = PATIENCE_S) -> tuple[int, str]:
    """Code and reason with which the server closes a websocket."""
    end_s = time.monotonic() + timeout_s
    try:
        while True:
            socket.recv(timeout=left_s(end_s))
    except ConnectionClosed as end:
        if end.rcvd is None:
            pytest.fail("it was cut off without a close frame")
        return int(end.rcvd.code), end.rcvd.reason
