"""Scene file's content in messages and sessions: any JSON within bounds, stored unchanged.

Server and sessions only store it, for people and for `foottile node`; `devices.scene` interprets
it.
"""

from __future__ import annotations

import json
import math
from typing import Annotated, Any

from pydantic import AfterValidator

from devices.types import check_text

SCENE_BYTES_MAX = 256 << 10
_DEPTH_MAX = 16
_KEY_LENGTH_MAX = 200
_INTEGER_END = 2**63


def _check_bounds(content: dict[str, Any]) -> dict[str, Any]:
    _check_value(content, 0)
    if len(json.dumps(content)) > SCENE_BYTES_MAX:
        raise ValueError(f"is longer than {SCENE_BYTES_MAX} bytes")
    return content


def _check_value(value: Any, depth: int) -> None:
    if depth > _DEPTH_MAX:
        raise ValueError(f"is nested more than {_DEPTH_MAX} times")
    if isinstance(value, dict):
        for key, inside in value.items():
            if len(key) > _KEY_LENGTH_MAX:
                raise ValueError(f"has a key of {len(key)} letters")
            check_text(key)
            _check_value(inside, depth + 1)
    elif isinstance(value, list | tuple):
        for inside in value:
            _check_value(inside, depth + 1)
    elif isinstance(value, str):
        check_text(value)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError("has a number that is not finite")
    elif isinstance(value, int) and not -_INTEGER_END <= value < _INTEGER_END:
        raise ValueError("has an integer of more than 64 bits")


SceneContent = Annotated[dict[str, Any], AfterValidator(_check_bounds)]
