"""An S3-compatible store on this machine, and a way to it that throttles and breaks off."""

from __future__ import annotations

import http.client
import logging
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pyarrow.fs as fs
import pytest
from moto.server import ThreadedMotoServer

SLOW_DOWN = b"<Error><Code>SlowDown</Code><Message>Reduce your request rate</Message></Error>"
BUCKET = "lab"


class Store:
    """A store with one empty bucket. Use as a context manager."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._monkeypatch = monkeypatch

    def __enter__(self) -> Store:
        logging.getLogger("werkzeug").setLevel(logging.ERROR)
        self._server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
        self._server.start()
        self.host, self.port = self._server.get_host_and_port()
        self.endpoint = f"http://{self.host}:{self.port}"
        again = http.client.HTTPConnection(self.host, self.port)  # a process has one memory for all
        again.request("POST", "/moto-api/reset")
        again.getresponse().read()
        again.close()
        for name, value in self.environment().items():
            self._monkeypatch.setenv(name, value)
        self.files = fs.S3FileSystem(endpoint_override=self.endpoint, allow_bucket_creation=True)
        self.files.create_dir(BUCKET)
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()

    def environment(self) -> dict[str, str]:
        """As a user sets it."""
        return {
            "AWS_ACCESS_KEY_ID": "one",
            "AWS_SECRET_ACCESS_KEY": "two",
            "AWS_REGION": "us-east-1",
            "AWS_EC2_METADATA_DISABLED": "true",
            "AWS_ENDPOINT_URL": self.endpoint,
        }

    def put(self, folder: Path, prefix: str) -> None:
        """Copy what is in a folder into the bucket."""
        for path in folder.rglob("*"):
            if path.is_file():
                where = f"{BUCKET}/{prefix}/{path.relative_to(folder)}"
                with self.files.open_output_stream(where) as sink:
                    sink.write(path.read_bytes())

    def content(self, prefix: str) -> dict[str, bytes]:
        """All objects below a prefix."""
        selector = fs.FileSelector(f"{BUCKET}/{prefix}", recursive=True)
        found = self.files.get_file_info(selector)
        return {
            info.path.removeprefix(f"{BUCKET}/{prefix}/"): self._read(info.path)
            for info in found
            if info.type == fs.FileType.File
        }

    def _read(self, path: str) -> bytes:
        with self.files.open_input_file(path) as file:
            return bytes(file.read())


_OF_ONE_HOP = ("content-length", "transfer-encoding", "connection", "expect")
Trouble = Callable[[int, str, str], str]
"""What becomes of a request with this number, method and path: "pass", "slow down", "cut"."""


class BadWay:
    """Passes requests on to a store, or answers 503, or breaks off in the middle of an answer."""

    def __init__(self, store: Store, trouble: Trouble) -> None:
        self.store, self.trouble = store, trouble
        self.passed = self.refused = self.cut = 0
        self._lock = threading.Lock()

    def __enter__(self) -> BadWay:
        way = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle_any(self) -> None:
                way.handle(self)

            do_GET = do_PUT = do_HEAD = do_POST = do_DELETE = handle_any  # noqa: N815  # http.server's names

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, name="way")
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}"

    def handle(self, asked: BaseHTTPRequestHandler) -> None:
        body = _body(asked)
        with self._lock:
            kind = self.trouble(self.passed + self.refused + self.cut, asked.command, asked.path)
            self.passed += kind == "pass"
            self.refused += kind == "slow down"
            self.cut += kind == "cut"
        if kind == "slow down":
            asked.send_response(503)
            asked.send_header("Content-Type", "application/xml")
            asked.send_header("Content-Length", str(len(SLOW_DOWN)))
            asked.end_headers()
            if asked.command != "HEAD":
                asked.wfile.write(SLOW_DOWN)
            return
        connection = http.client.HTTPConnection(self.store.host, self.store.port)
        headers = {n: v for n, v in asked.headers.items() if n.lower() not in _OF_ONE_HOP}
        connection.request(asked.command, asked.path, body, headers)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        asked.send_response(answer.status)
        for name, value in answer.getheaders():
            if name.lower() not in _OF_ONE_HOP:
                asked.send_header(name, value)
        length = answer.getheader("Content-Length") if asked.command == "HEAD" else len(content)
        asked.send_header("Content-Length", str(length or 0))
        if kind == "cut":
            asked.end_headers()
            asked.wfile.write(content[: len(content) // 2])
            asked.close_connection = True
            return
        asked.end_headers()
        asked.wfile.write(content)


def _body(asked: BaseHTTPRequestHandler) -> bytes:
    if asked.headers.get("Transfer-Encoding") != "chunked":
        return asked.rfile.read(int(asked.headers.get("Content-Length") or 0))
    body = b""
    while size := int(asked.rfile.readline(), 16):
        body += asked.rfile.read(size)
        asked.rfile.readline()
    asked.rfile.readline()
    return body
