"""A sealed session of a server that runs, and how its data are asked for."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import httpx

from tests.service.recording import Recording
from tests.service.running import Running


@dataclass(frozen=True)
class Sealed:
    """A sealed session of 300 frames at 20 and 60 N, and one that is still recorded."""

    running: Running
    session: Recording
    content: bytes
    recording: Recording

    @property
    def id(self) -> str:
        return self.session.id

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.content).hexdigest()

    def get(self, method: str = "GET", **headers: str) -> httpx.Response:
        return self.running.http.request(
            method, f"{self.session.url}/data", headers={"Accept-Encoding": "identity"} | headers
        )

    def made(self, session: Recording | None = None, **query: Any) -> httpx.Response:
        url = f"{(session or self.session).url}/data"
        return self.running.http.get(url, params=query)
