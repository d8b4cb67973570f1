"""Whatever a server writes in its data folder: at the next start the folder is known as ours."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator

import pytest

from service.api.address import load_or_create_token
from storage.durable_files import set_aside_damaged
from storage.permissions import set_umask_and_create_private_folder
from tests.service.fake_node import FakeNode
from tests.service.running import Running


@pytest.fixture(autouse=True)
def _umask() -> Iterator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


def test_a_folder_that_a_server_has_used_is_closed_to_others(
    running: Running, tared: FakeNode
) -> None:
    load_or_create_token(None, running.data)
    deleted = tared.record()
    tared.deliver(10)
    tared.finish(deleted)
    assert running.http.delete(deleted.url).status_code == 204
    assert running.http.get("/ready").status_code == 200
    running.stop()
    set_aside_damaged(running.data / "server_id")
    running.start()
    running.data.chmod(0o755)
    set_umask_and_create_private_folder(running.data)
    assert stat.S_IMODE(running.data.stat().st_mode) == 0o700, os.listdir(running.data)
