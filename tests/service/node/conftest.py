"""Nodes of tests try again soon."""

from __future__ import annotations

import pytest

import service.node.tcp_connect


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try again soon."""
    monkeypatch.setattr(service.node.tcp_connect, "BACKOFF_S", (0.05, 0.1))
    monkeypatch.setattr(service.node.tcp_connect, "REFUSED_BACKOFF_S", (0.05, 0.1))
