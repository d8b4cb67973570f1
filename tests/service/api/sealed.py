"""A sealed session of a running server, and its downloads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import httpx

from tests.service.recording import Recording
from tests.service.running import Running


@dataclass(frozen=True)
class Sealed:
    """A sealed session of 300 frames at 20 and 60 N, its file, and a session that is recorded."""

    running: Running
    session: Recording
    content: bytes
    recording: Recording

    @property
    def id(self) -> str:
        return self.session.id

    def get_file(self, **headers: str) -> httpx.Response:
        """Get the stored file."""
        headers = {"Accept-Encoding": "identity"} | headers
        return self.running.http.get(f"{self.session.url}/data", headers=headers)

    def export(self, session: Recording | None = None, **query: Any) -> httpx.Response:
        """Get a session in a format, by default the sealed one."""
        url = f"{(session or self.session).url}/data"
        return self.running.http.get(url, params=query)
