"""What every export states of itself: time base, axes, and what is not as it was measured."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Literal

Complete = bool | Literal["lossy"] | None
"""Is every frame of the session there? None: nothing says so, as of a simulation."""

AXES = (
    "Foot frame: x forward, y to the left, z along the segment towards the ankle, origin at the "
    "ankle joint. Ground frame (cop_ground_*): the same axes levelled, z up, origin on the ground "
    "under the ankle at angle 0. Forces are those of the ground on the foot, positive upwards."
)
MASKED = (
    "Estimates are missing where they are not known, and estimate_status says why: no centre of "
    "pressure without contact or in doubt (16), no GRF with a tile saturated (1) or missing (32). "
    "Of tiles in one row the COP is not measured across the row. "
    "Nothing stands in their place."
)
_NODES = "The node's clock (t_ns), UTC since 1970, as its node had it set."
_SERVERS = (
    "The server's clock (t_server_ns), UTC since 1970, within t_server_uncertainty_ns; the node's "
    "own is t_ns."
)


def facts_of(
    notes: Mapping[str, object], source: Mapping[str, object], *, has_server_time: bool
) -> dict[str, object]:
    """Facts of an export of frames as they were measured, as JSON.

    Args:
        notes: of the session, with its ledger if it is sealed.
        source: with the `state` of one that is not.
        has_server_time: was it asked for?
    """
    complete, lost = completeness(notes, source)
    return {
        "complete": complete,
        "lost": lost,
        "time_base": _SERVERS if has_server_time else _NODES,
        "axes": AXES,
        "resampled": "nothing",
        "filled": "nothing",
        "masked": MASKED,
    }


def completeness(
    notes: Mapping[str, object], source: Mapping[str, object]
) -> tuple[Complete, dict[str, int]]:
    """Is it complete, and how many frames are lost for which reason."""
    if "state" in source:  # it is not sealed: more may come
        return False, {}
    ledger = notes.get("ledger")
    if not isinstance(ledger, dict):
        return None, {}
    lost: Counter[str] = Counter()
    for part in ledger["parts"]:
        lost.update(part["lost"])
    return "lossy" if ledger["lossy"] else bool(ledger["complete"]), dict(lost)
