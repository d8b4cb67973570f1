"""Conversion of results to JSON: non-finite numbers to null, dataclasses to objects."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any


def to_json_value(value: Any) -> Any:
    """Convert a result to JSON values: non-finite numbers to null, dataclasses to objects.

    An object with a method `as_dict` is converted by that.
    """
    if hasattr(value, "as_dict"):
        return to_json_value(value.as_dict())
    if is_dataclass(value):
        return {f.name: to_json_value(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {name: to_json_value(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_value(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json_text(value: object) -> str:
    """Format any result as a JSON document."""
    return json.dumps(to_json_value(value), indent=2, allow_nan=False) + "\n"
