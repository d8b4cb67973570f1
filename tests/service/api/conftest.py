"""Servers and sessions for several modules."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from service.api.settings import LimitSettings
from tests.service.api.access import TOKEN
from tests.service.api.sealed import Sealed
from tests.service.fake_node import FakeNode
from tests.service.patient import patient_server
from tests.service.running import Running, ServeWith


@pytest.fixture
def strict(serve_with: ServeWith) -> Running:
    """A server with short time-outs and few places."""
    bounds = LimitSettings(
        max_connections=3,
        max_header_bytes=4096,
        header_timeout_s=0.3,
        body_timeout_s=0.3,
        idle_timeout_s=0.3,
    )
    return serve_with(bounds=bounds)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A server of a module whose tests leave nothing behind that another test sees."""
    with patient_server(tmp_path_factory.mktemp("shared") / "data") as running:
        yield running


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A server whose requests show no token but those that a test gives."""
    with patient_server(tmp_path_factory.mktemp("guarded") / "data", token=TOKEN) as running:
        yield running


@pytest.fixture(scope="module")
def shared_tared(shared: Running) -> Iterator[FakeNode]:
    """A tared node of a module's server."""
    node = FakeNode(shared)
    node.connect()
    node.tared()
    node.acknowledged(69)
    yield node
    node.close()


@pytest.fixture(scope="module")
def sealed(shared_tared: FakeNode) -> Sealed:
    """A sealed session of 300 frames, and one of 50 frames that is still recorded."""
    node = shared_tared
    session = node.record_sealed(300, [20.0, 60.0])
    recording = node.record(name="Ünder/..\\ 3rd trial")
    node.deliver(50, [5.0, 0.0])
    content = (session.folder / "frames.parquet").read_bytes()
    return Sealed(node.running, session, content, recording)
