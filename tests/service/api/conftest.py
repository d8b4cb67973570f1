"""Servers and sessions that several modules ask for."""

from __future__ import annotations

import pytest

from service.api.connection_limits import LimitSettings
from tests.service.api.sealed import Sealed
from tests.service.fake_node import FakeNode
from tests.service.running import Running, ServeWith


@pytest.fixture
def strict(serve_with: ServeWith) -> Running:
    """A server that is soon out of patience and of places."""
    bounds = LimitSettings(
        max_connections=3,
        max_header_bytes=4096,
        header_timeout_s=0.3,
        body_timeout_s=0.3,
        idle_timeout_s=0.3,
    )
    return serve_with(bounds=bounds)


@pytest.fixture
def sealed(running: Running, tared: FakeNode) -> Sealed:
    """Of 300 frames; a second one is recorded."""
    session = tared.record()
    tared.deliver(300, [20.0, 60.0])
    tared.finish(session)
    recording = tared.record()
    tared.deliver(50, [5.0, 0.0])
    content = (session.folder / "frames.parquet").read_bytes()
    return Sealed(running, session, content, recording)
