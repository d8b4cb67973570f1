"""Calibration programme of a rig recording, from its markers.

A marker begins a step: `T01 load`: the spindle moves down on tile T01; `T01 500 g`: a weight is on
it; `soak` and `end`: no load. Other markers are remarks. A misspelt step is an error, because the
step before would be extended beyond its end.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from devices.errors import CalibrationError
from service.estimation.weights import parse_weight
from storage.schema import NO_INSTANT
from storage.sessions.beside import EVENTS_NAME, clock_beside, read_events
from storage.sessions.folder import Event
from storage.sessions.reader import SessionReader

PRESSED = ("rest", "load", "unload", "hold", "release", "tap")
"""Steps of a marker that begins with a tile's serial."""
IDLE = {"soak": "soak", "end": "rest"}
"""Phase of each marker without a serial."""
_FORM = (
    "SERIAL and one of "
    + ", ".join(PRESSED)
    + ", or a weight such as 500 g, 4.9 N or 500 g +-0.5 %; or "
    + " or ".join(IDLE)
)

Programme = tuple[npt.NDArray[np.object_], npt.NDArray[np.str_]]
"""Programme by frame: serial of the loaded tile, or None, and phase."""


def programme_of(session: SessionReader) -> Programme | None:
    """Read the calibration programme from a sealed session's markers; None: they have no step.

    Raises:
        CalibrationError: a marker is misspelt or has no frame.
        FileFormatError: the markers file is damaged.
    """
    try:
        events = read_events(session.path.with_name(EVENTS_NAME)).events
    except FileNotFoundError:
        return None
    serials, where = session.info.serials, str(session.path.parent)
    parsed = [(event, _said_by(event, serials, where)) for event in events]
    steps = sorted(((event.t_ns, step) for event, step in parsed if step is not None))
    if not steps:
        return None
    clock = clock_beside(session)
    pieces = [
        clock.columns(piece["t_mono_ns"], piece["t_ns"], None)["t_server_ns"]
        for piece in session.columns("t_mono_ns", "t_ns")
    ]
    t_server_ns = np.concatenate(pieces)
    if (t_server_ns == NO_INSTANT).any():
        raise CalibrationError(
            "the markers are on the server's clock, and the node's clock was not compared with it",
            where=where,
            remedy="Record once the node's clock is measured, some seconds after it connects",
        )
    step_at = np.searchsorted([t_ns for t_ns, _ in steps], t_server_ns, side="right")
    tiles = np.array([None, *(tile or None for _, (tile, _) in steps)], dtype=object)
    phases = np.array(["rest", *(phase for _, (_, phase) in steps)], dtype=np.str_)
    return tiles[step_at], phases[step_at]


def _said_by(event: Event, serials: Sequence[str], where: str) -> tuple[str, str] | None:
    """Parse a marker into serial (empty for none) and phase; None for a remark.

    Raises:
        CalibrationError: it resembles a step but is not one.
    """
    label = event.label.strip()
    if label in IDLE:
        return "", IDLE[label]
    for serial in serials:
        weight = label.removeprefix(f"{serial} ").strip()
        if weight != label and parse_weight(weight) is not None:
            return serial, weight
    serial, _, phase = (part.strip() for part in label.rpartition(" "))
    if serial in serials and phase in PRESSED:
        return serial, phase
    begins = any(re.match(rf"{re.escape(known)}\b", label) for known in serials)
    if begins or phase in PRESSED or label.lower() in IDLE:
        raise CalibrationError(
            f"mark {label[:80]!r} is no calibration step",
            where=where,
            expected=f"{_FORM}, of a tile of {', '.join(serials)}",
            remedy="Rename or remove it on the session's page",
        )
    return None
