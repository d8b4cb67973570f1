"""Journals that a test has opened are closed with it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.storage.journal.journals import OPENED


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    while OPENED:
        OPENED.pop().close()
