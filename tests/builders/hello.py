"""A hello of a node that has no frames yet."""

from __future__ import annotations

from typing import Any

from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.protocol.link import PROTOCOL, Hello


def make_hello(
    array_info: ArrayInfo, calibration: Calibration | None = None, **changes: Any
) -> Hello:
    """Return the hello of a node that has no frames yet."""
    content: dict[str, Any] = {
        "protocol": PROTOCOL,
        "array_info": array_info,
        "stored": (),
        "next_seq": 0,
        "t_mono_ns": 0,
        "scene": {"name": "test"},
        "emulated": False,
        "calibration": calibration,
        "calibration_problem": None if calibration else "for this test",
    }
    return Hello(**(content | changes))
