"""A take of some nodes."""

from __future__ import annotations

from typing import Self

import httpx
import pytest

import service.api.routes.recordings.sessions
import service.server.recorder
from tests.service.fake_node import FakeNode
from tests.service.running import Running


def frames_of_long_ago(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let sessions have them, though they began later."""
    monkeypatch.setattr(service.server.recorder, "MAX_DELAY_S", 1e9)
    monkeypatch.setattr(service.api.routes.recordings.sessions, "SEAL_TIMEOUT_S", 0.2)


class Take:
    """A hundred frames of each of some nodes, recorded together."""

    def __init__(self, running: Running, feet: list[FakeNode]) -> None:
        self.running, self.feet = running, feet
        for foot in feet:
            foot.connect()
            if foot.calibration is None:  # then there is nothing to tare for
                foot.send(70)
            else:
                foot.tared()
            foot.acknowledged(69)
        begun = running.http.post("/takes", json={"name": "both"}).json()
        self.id = begun["id"]
        self.url = f"/takes/{self.id}/data"
        self.sessions = [running.session(each["id"]) for each in begun["sessions"]]
        for foot in feet:
            foot.deliver(100, [20.0, 60.0])

    def sealed(self) -> Self:
        """Stopped, and all of it on the server."""
        self.running.http.post(f"/takes/{self.id}/stop")
        for foot in self.feet:
            foot.send(30, now=True)
        for session in self.sessions:
            session.sealed()
        return self

    def get(self, to: str, **query: object) -> httpx.Response:
        """It in a format."""
        asked = {"format": to, **query}
        return self.running.http.get(self.url, params={k: str(v) for k, v in asked.items()})
