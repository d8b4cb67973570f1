"""Version of FootTile."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

SOFTWARE_VERSION = f"foottile {version('foottile')}"

SOFTWARE_DATE = datetime(2026, 11, 1, tzinfo=UTC)
"""Date before which no clock is right: that of a recent version. A machine without a battery clock
begins in 1970; nothing that lasts is dated before."""


@cache
def compute_exact_version() -> str:
    """Return the version with a hash of the source code, for exact reproducibility."""
    digest = hashlib.sha256()
    for name in ("devices", "storage", "service", "studies"):
        folder = Path(str(import_module(name).__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
            digest.update(path.read_bytes())
    return f"{SOFTWARE_VERSION} ({digest.hexdigest()[:12]})"
