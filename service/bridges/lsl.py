"""Lab Streaming Layer: an outlet of samples for each node, and one of markers for all.

Samples have the instant when they were measured, by LSL's own clock: the node's time becomes the
server's, and this the time of this machine, which is LSL's (`steady_clock`, CLOCK_MONOTONIC on
Linux). Both steps have a bound, and their sum is a channel. Names, units and descriptions of the
channels are metadata as in an XDF file.
"""

from __future__ import annotations

import numpy as np
import pylsl

from devices.frames import ArrayInfo
from service.bridges.follower import Event, LiveClock, LiveFrames, Outlet, Reporter
from storage.formats.writers.format import to_floats_with_nan
from storage.schema import ESTIMATE_COLUMNS, UNKNOWN_T_NS, Column, map_flat_columns

_BUFFERED_S = 10
"""Longest time that samples wait for a slow inlet; then the oldest are dropped."""
_QUANTITIES = ("seq", *(column.name for column in ESTIMATE_COLUMNS), "tile_flags", "frame_flags")
TIME_BOUND = "time_uncertainty_s"
"""Channel with the bound of the sample's instant."""


def limit_to_this_machine() -> None:
    """Let only programs of this machine find the outlets; call it before any outlet is made."""
    pylsl.util.set_config_content("[multicast]\nResolveScope = machine\n[log]\nlevel = -1\n")


class LslOutlet(Outlet):
    """Outlets of all nodes.

    Args:
        reporter: reporter of problems.
    """

    columns = ("t_mono_ns", *_QUANTITIES)

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter
        self._nodes: dict[str, tuple[object, pylsl.StreamOutlet]] = {}
        info = pylsl.StreamInfo("foottile markers", "Markers", 1, 0.0, "string", "foottile markers")
        self._markers = pylsl.StreamOutlet(info, 0, _BUFFERED_S)

    def write_frames(self, frames: LiveFrames, server_clock: LiveClock) -> None:
        """Push the samples of frames whose instant is known."""
        known = np.flatnonzero(frames.columns["t_server_ns"] != UNKNOWN_T_NS)
        local = server_clock.to_mono_ns(frames.columns["t_server_ns"][known])
        if local is None or not len(known):
            problem = "no samples: its clock is not compared with the server's yet"
            self._reporter.report(f"clock of {frames.node}", problem)
            return
        self._reporter.report(f"clock of {frames.node}", None)
        node, key = self._nodes.get(frames.node), (frames.info.tiles, frames.info.nominal_rate_hz)
        if node is None or node[0] != key:
            self._nodes.pop(frames.node, None)  # its outlet ends before another of the same name
            node = self._nodes[frames.node] = key, _make_outlet(frames.info)
        samples = [
            to_floats_with_nan(quantity.name, frames.columns[name][known])
            for name, quantity in _list_channels(frames.info)
        ]
        samples.append((local[1] + frames.columns["t_server_uncertainty_ns"][known]) * 1e-9)
        node[1].push_chunk(np.stack(samples, axis=1), (local[0] * 1e-9).tolist())

    def write_event(self, event: Event, server_clock: LiveClock) -> None:
        """Push an event as a marker at its instant."""
        local = server_clock.to_mono_ns(np.array([event.t_ns]))
        if local is not None:
            self._markers.push_sample([str(event)], float(local[0][0]) * 1e-9)

    def close(self) -> None:
        """End all outlets."""
        self._nodes.clear()
        del self._markers


def _list_channels(info: ArrayInfo) -> list[tuple[str, Column]]:
    """Return name and quantity of each channel but the last."""
    found = map_flat_columns(len(info.tiles)).items()
    return [(name, column) for name, column in found if column.name in _QUANTITIES]


def _make_outlet(info: ArrayInfo) -> pylsl.StreamOutlet:
    """Make the outlet of a node, with metadata as the XDF writer's."""
    named = _list_channels(info)
    stream = pylsl.StreamInfo(
        f"{info.node} frames",
        "Force",
        len(named) + 1,
        info.nominal_rate_hz,
        "double64",
        f"foottile {info.node} frames",
    )
    channels = stream.desc().append_child("channels")
    for name, column in named:
        channel = channels.append_child("channel")
        channel.append_child_value("label", name).append_child_value("unit", column.unit)
        channel.append_child_value("type", "Force")
        channel.append_child_value("description", column.description)
        if column.per_tile:
            tile = info.tiles[int(name.removeprefix(f"{column.name}_"))]
            channel.append_child_value("serial", tile.serial)
    channel = channels.append_child("channel")
    channel.append_child_value("label", TIME_BOUND).append_child_value("unit", "s")
    channel.append_child_value("type", "Force")
    channel.append_child_value("description", "bound of the sample's instant, plus or minus")
    return pylsl.StreamOutlet(stream, 0, _BUFFERED_S)
