"""A server for many tests, which takes its time with nodes that tests play."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import service.api.routes.recordings.sessions
import service.api.routes.sockets.ingest
import service.server.recorder
from tests.service.running import Running
from tests.waiting import PATIENCE_S


def be_patient(
    patch: pytest.MonkeyPatch, *, settle_s: float = 0.1, silence_s: float = PATIENCE_S
) -> None:
    """Servers of this process listen in vain for so long, and take frames of long ago."""
    patch.setattr(service.server.recorder, "MAX_DELAY_S", 1e9)
    patch.setattr(service.api.routes.recordings.sessions, "SEAL_TIMEOUT_S", settle_s)
    patch.setattr(service.api.routes.sockets.ingest, "LINK_TIMEOUT_S", silence_s)


@contextmanager
def patient_server(data: Path) -> Iterator[Running]:
    """One that runs, on loopback."""
    running = Running(data)
    with pytest.MonkeyPatch.context() as patch:
        be_patient(patch)
        running.start()
        try:
            yield running
        finally:
            running.stop()
