"""A server that many tests share, patient with nodes that tests play."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import service.api.routes.recordings.sessions
import service.api.routes.sockets.ingest
import service.server.recorder
import service.server.server
from tests.service.running import Running
from tests.waiting import PATIENCE_S

TICK_S = 0.02


def be_patient(
    patch: pytest.MonkeyPatch, *, settle_s: float = 0.1, silence_s: float = PATIENCE_S
) -> None:
    """Let servers of this process wait so long for silent nodes, take old frames, tick quickly."""
    patch.setattr(service.server.server, "TICK_S", TICK_S)
    patch.setattr(service.server.recorder, "MAX_DELAY_S", 1e9)
    patch.setattr(service.api.routes.recordings.sessions, "SEAL_TIMEOUT_S", settle_s)
    patch.setattr(service.api.routes.sockets.ingest, "LINK_TIMEOUT_S", silence_s)


@contextmanager
def patient_server(data: Path, **options: Any) -> Iterator[Running]:
    """Run a server on loopback; options as of `Running`."""
    running = Running(data, **options)
    with pytest.MonkeyPatch.context() as patch:
        be_patient(patch)
        running.start()
        try:
            yield running
        finally:
            running.stop()
