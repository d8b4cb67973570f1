"""Version of FootTile."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

SOFTWARE_VERSION = f"foottile {version('foottile')}"


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
