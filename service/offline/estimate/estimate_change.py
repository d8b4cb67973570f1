"""Difference between a new estimate of a session and its stored one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devices.arrays import Floats, Ints
from devices.errors import FileFormatError
from storage.schema import CONTACT_UNKNOWN
from storage.sessions.reader import SealedFileReader

_COLUMNS = ("t_ns", "grf_n", "contact")


@dataclass(frozen=True)
class StoredEstimates:
    """Stored GRF and contact of a session's frames, with the look-ahead of their estimate."""

    lag_ms: float
    t_ns: Ints
    grf_n: Floats
    contact: Ints


@dataclass(frozen=True)
class EstimateChange:
    """Difference of two estimates of the same frames."""

    lag_before_ms: float
    frames: int
    """Number of common frames with a GRF in both."""
    grf_rms_n: float
    grf_most_n: float
    contact_frames: int
    """Frames whose contact is another one."""


def read_stored_estimates(path: Path) -> StoredEstimates | None:
    """Read a session's stored estimates; None if it has none or they are damaged.

    Damaged estimates are no error here: a new estimate needs the raw counts only.
    """
    try:
        with SealedFileReader(path, only_slices=True) as session:
            lag_ms = session.notes.get("lag_ms")
            if not isinstance(lag_ms, int | float) or not session.has_columns(*_COLUMNS):
                return None
            pieces = list(session.read_quantities(*_COLUMNS))
    except FileFormatError:
        return None
    if not pieces:
        return None
    t_ns, grf_n, contact = (np.concatenate([piece[name] for piece in pieces]) for name in _COLUMNS)
    return StoredEstimates(float(lag_ms), t_ns, grf_n, contact)


def compute_estimate_change(before: StoredEstimates, after: StoredEstimates) -> EstimateChange:
    """Compute the difference over the common frames."""
    _, i, j = np.intersect1d(before.t_ns, after.t_ns, return_indices=True)
    apart_n = after.grf_n[j].astype(np.float64) - before.grf_n[i]
    known_n = apart_n[np.isfinite(apart_n)]
    contacts = before.contact[i], after.contact[j]
    is_known = (contacts[0] != CONTACT_UNKNOWN) & (contacts[1] != CONTACT_UNKNOWN)
    return EstimateChange(
        lag_before_ms=before.lag_ms,
        frames=len(known_n),
        grf_rms_n=float(np.sqrt((known_n**2).mean())) if len(known_n) else float("nan"),
        grf_most_n=float(np.abs(known_n).max()) if len(known_n) else float("nan"),
        contact_frames=int((is_known & (contacts[0] != contacts[1])).sum()),
    )
