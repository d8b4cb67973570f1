"""Unique names and instants for formats that put several sessions on one time axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from devices.arrays import Times
from devices.errors import UsageError
from storage.formats.export import Export
from storage.schema import UNKNOWN_T_NS, Array


def make_names_unique(names: Sequence[str]) -> list[str]:
    """Return the names with a number appended to repeated ones, such as `left_2`."""
    unique: list[str] = []
    for name in names:
        number, candidate = 1, name
        while candidate in unique:
            number += 1
            candidate = f"{name}_{number}"
        unique.append(candidate)
    return unique


def get_instants_on_export_clock_ns(export: Export, columns: Mapping[str, Array]) -> Times:
    """Return the instants of frames on the export's clock, int64[n].

    Args:
        export: export of the frames.
        columns: `t_ns`, `part` if the session has parts, `t_server_ns` with the server's clock.

    Raises:
        UsageError: the server's time of some frames is unknown.
    """
    t_ns: Times = (
        export.to_session_axis_ns(columns) if export.clock is None else columns["t_server_ns"]
    )
    unknown = int((t_ns == UNKNOWN_T_NS).sum())
    if unknown:
        raise UsageError(
            f"the server's time is not known for {unknown} frames",
            where=export.display_name,
            remedy="Ask for the node's clock, or a slice of a part whose clock was compared",
        )
    return t_ns
