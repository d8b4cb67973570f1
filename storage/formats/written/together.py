"""What formats share that put several sessions on one axis of time: names that differ, instants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from devices.arrays import Times
from devices.errors import UsageError
from storage.formats.export import Export
from storage.schema import NO_INSTANT, Array


def distinct(names: Sequence[str]) -> list[str]:
    """These names; one that is there already ends in a number, as `left_2`."""
    found: list[str] = []
    for name in names:
        number, differs = 1, name
        while differs in found:
            number += 1
            differs = f"{name}_{number}"
        found.append(differs)
    return found


def instants_of(export: Export, columns: Mapping[str, Array]) -> Times:
    """Instants of frames on the clock that was asked for, int64[n].

    Args:
        export: whose frames they are.
        columns: `t_ns`, `part` if it has parts, `t_server_ns` if the server's clock was asked for.

    Raises:
        UsageError: it was, and of some frames the server's time is not known.
    """
    t_ns: Times = export.at_ns(columns) if export.clock is None else columns["t_server_ns"]
    unknown = int((t_ns == NO_INSTANT).sum())
    if unknown:
        raise UsageError(
            f"of {unknown} frames the server's time is not known",
            where=export.called,
            remedy="Ask for the node's clock, or a slice of a part whose clock was compared",
        )
    return t_ns
