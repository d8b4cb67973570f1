"""Nodes of tests try again soon."""

from __future__ import annotations

import pytest

import service.node.server_connection


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try again soon."""
    monkeypatch.setattr(service.node.server_connection, "BACKOFF_S", (0.05, 0.1))
    monkeypatch.setattr(service.node.server_connection, "REFUSED_BACKOFF_S", (0.05, 0.1))
