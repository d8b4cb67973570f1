"""A command of `foottile` within this process."""

from __future__ import annotations

import sys

import pytest

from service.cli.main import main


def command(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Run it; its exit code."""
    monkeypatch.setattr(sys, "argv", ["foottile", *map(str, arguments)])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0
