"""Facts that every export states: completeness, time base, axes, resampling, masked values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Literal

Completeness = bool | Literal["lossy"] | None
"""Completeness of a session: True, False or "lossy". None: unknown, as for a simulation."""

AXES_TEXT = (
    "Foot frame: x forward, y to the left, z along the segment towards the ankle, origin at the "
    "ankle joint. Ground frame (cop_ground_*): the same axes levelled, z up, origin on the ground "
    "under the ankle at angle 0. Forces are those of the ground on the foot, positive upwards."
)
MASKED_TEXT = (
    "Unknown estimates are missing, and estimate_flags says why: no centre of "
    "pressure without contact or in doubt (16), no GRF with a tile saturated (1) or missing (32). "
    "Of tiles in one row the COP is not measured across the row. "
    "They are not replaced."
)
_NODE_TIME_BASE = "The node's clock (t_ns), UTC since 1970, as set on the node."
_SERVER_TIME_BASE = (
    "The server's clock (t_server_ns), UTC since 1970, within t_server_uncertainty_ns; the node's "
    "own is t_ns."
)


def describe_completeness_and_axes(
    notes: Mapping[str, object], provenance: Mapping[str, object], *, has_server_time: bool
) -> dict[str, object]:
    """Return completeness, losses, time base and axes of an export of unmodified frames, as JSON.

    Args:
        notes: notes of the session, with its ledger if it is sealed.
        provenance: session and hashes; has `state` if the session is not sealed.
        has_server_time: True if the export has the server's time.
    """
    complete, lost = read_completeness_and_losses(notes, provenance)
    return {
        "complete": complete,
        "lost": lost,
        "time_base": _SERVER_TIME_BASE if has_server_time else _NODE_TIME_BASE,
        "axes": AXES_TEXT,
        "resampled": "nothing",
        "filled": "nothing",
        "masked": MASKED_TEXT,
    }


def read_completeness_and_losses(
    notes: Mapping[str, object], provenance: Mapping[str, object]
) -> tuple[Completeness, dict[str, int]]:
    """Return the completeness of a session, and its number of lost frames by reason."""
    if "state" in provenance:  # not sealed: frames may follow
        return False, {}
    ledger = notes.get("ledger")
    if not isinstance(ledger, dict):
        return None, {}
    lost: Counter[str] = Counter()
    for part in ledger["parts"]:
        lost.update(part["lost"])
    return "lossy" if ledger["lossy"] else bool(ledger["complete"]), dict(lost)
