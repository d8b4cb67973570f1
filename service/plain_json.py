"""Results as JSON: what is not finite is null, a dataclass an object."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any


def plain(value: Any) -> Any:
    """A result as JSON can hold it: what is not finite is null, a dataclass an object.

    A dataclass with a method `as_dict` is what that says.
    """
    if hasattr(value, "as_dict"):
        return plain(value.as_dict())
    if is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_text(value: object) -> str:
    """A JSON document of any result."""
    return json.dumps(plain(value), indent=2, allow_nan=False) + "\n"
