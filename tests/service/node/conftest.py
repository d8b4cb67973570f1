"""Nodes of tests try again soon."""

from __future__ import annotations

import pytest

import service.node.dial


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try again soon."""
    monkeypatch.setattr(service.node.dial, "BACK_OFF_S", (0.05, 0.1))
    monkeypatch.setattr(service.node.dial, "REFUSED_BACK_OFF_S", (0.05, 0.1))
