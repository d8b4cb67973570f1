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
from service.estimation.dead_weights import parse_weight
from storage.schema import UNKNOWN_T_NS
from storage.sessions.folder import Marker
from storage.sessions.reader import SealedFileReader
from storage.sessions.sidecars import MARKERS_NAME, load_clock_table, read_markers

TILE_STEPS = ("rest", "load", "unload", "hold", "release", "tap")
"""Steps of a marker that begins with a tile's serial."""
IDLE_PHASES = {"soak": "soak", "end": "rest"}
"""Phase of each marker without a serial."""
_EXPECTED_FORM = (
    "SERIAL and one of "
    + ", ".join(TILE_STEPS)
    + ", or a weight such as 500 g, 4.9 N or 500 g +-0.5 %; or "
    + " or ".join(IDLE_PHASES)
)

RigProgramme = tuple[npt.NDArray[np.object_], npt.NDArray[np.str_]]
"""Programme by frame: serial of the loaded tile, or None, and phase."""


def read_rig_programme(session: SealedFileReader) -> RigProgramme | None:
    """Read the calibration programme from a sealed session's markers; None: they have no step.

    Raises:
        CalibrationError: a marker is misspelt or has no frame.
        FileFormatError: the markers file is damaged.
    """
    try:
        events = read_markers(session.path.with_name(MARKERS_NAME))
    except FileNotFoundError:
        return None
    serials, where = session.info.serials, str(session.path.parent)
    parsed = [(event, _parse_step_marker(event, serials, where)) for event in events]
    steps = sorted(((event.t_ns, step) for event, step in parsed if step is not None))
    if not steps:
        return None
    clock = load_clock_table(session)
    pieces = [
        clock.compute_server_time_columns(piece["t_mono_ns"], piece["t_ns"], None)["t_server_ns"]
        for piece in session.read_quantities("t_mono_ns", "t_ns")
    ]
    t_server_ns = np.concatenate(pieces)
    if (t_server_ns == UNKNOWN_T_NS).any():
        raise CalibrationError(
            "the markers are on the server's clock, and the node's clock was not compared with it",
            where=where,
            remedy="Record once the node's clock is measured, some seconds after it connects",
        )
    step_at = np.searchsorted([t_ns for t_ns, _ in steps], t_server_ns, side="right")
    tiles = np.array([None, *(tile or None for _, (tile, _) in steps)], dtype=object)
    phases = np.array(["rest", *(phase for _, (_, phase) in steps)], dtype=np.str_)
    return tiles[step_at], phases[step_at]


def _parse_step_marker(event: Marker, serials: Sequence[str], where: str) -> tuple[str, str] | None:
    """Parse a marker into serial (empty for none) and phase; None for a remark.

    Raises:
        CalibrationError: it resembles a step but is not one.
    """
    label = event.label.strip()
    if label in IDLE_PHASES:
        return "", IDLE_PHASES[label]
    for serial in serials:
        weight = label.removeprefix(f"{serial} ").strip()
        if weight != label and parse_weight(weight) is not None:
            return serial, weight
    serial, _, phase = (part.strip() for part in label.rpartition(" "))
    if serial in serials and phase in TILE_STEPS:
        return serial, phase
    begins = any(re.match(rf"{re.escape(known)}\b", label) for known in serials)
    if begins or phase in TILE_STEPS or label.lower() in IDLE_PHASES:
        raise CalibrationError(
            f"marker {label[:80]!r} is no calibration step",
            where=where,
            expected=f"{_EXPECTED_FORM}, of a tile of {', '.join(serials)}",
            remedy="Rename or remove it on the session's page",
        )
    return None
