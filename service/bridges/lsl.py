"""Lab Streaming Layer: an outlet of samples for each node, and one of markers for all.

Samples have the instant when they were measured, by LSL's own clock: the node's time becomes the
server's, and this the time of this machine, which is LSL's (`steady_clock`, CLOCK_MONOTONIC on
Linux). Both steps have a bound, and their sum is a channel. Names, units and descriptions of the
channels are metadata as in an XDF file.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
import pylsl

from devices.frames import ArrayInfo
from service.bridges.follower import Event, LiveClock, LiveFrames, Outlet, Reporter
from storage.formats.writers.format import to_floats_with_nan
from storage.schema import ESTIMATE_COLUMNS, UNKNOWN_T_NS, Array, Column, map_flat_columns

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
        self._nodes: dict[str, _NodeOutlet] = {}
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
        node, info = self._nodes.get(frames.node), frames.info
        if node is None or (node.info.tiles, node.info.nominal_rate_hz) != (
            info.tiles,
            info.nominal_rate_hz,
        ):
            self._nodes.pop(frames.node, None)  # its outlet ends before another of the same name
            node = self._nodes[frames.node] = _NodeOutlet(info)
        bound_ns = local[1] + frames.columns["t_server_uncertainty_ns"][known]
        columns = {name: frames.columns[name][known] for name in node.channels}
        node.push(columns, local[0] * 1e-9, bound_ns * 1e-9)

    def write_event(self, event: Event, server_clock: LiveClock) -> None:
        """Push an event as a marker at its instant."""
        local = server_clock.to_mono_ns(np.array([event.t_ns]))
        if local is not None:
            self._markers.push_sample([str(event)], float(local[0][0]) * 1e-9)

    def close(self) -> None:
        """End all outlets."""
        self._nodes.clear()
        del self._markers


class _NodeOutlet:
    """Outlet of a node, with metadata as the XDF writer's."""

    def __init__(self, info: ArrayInfo) -> None:
        self.info = info
        self.channels = {
            name: column
            for name, column in map_flat_columns(len(info.tiles)).items()
            if column.name in _QUANTITIES
        }
        stream = pylsl.StreamInfo(
            *(f"{info.node} frames", "Force", len(self.channels) + 1, info.nominal_rate_hz),
            *("double64", f"foottile {info.node} frames"),
        )
        described = stream.desc().append_child("channels")
        bound = Column(
            TIME_BOUND, pa.float64(), "s", "bound of the sample's instant, plus or minus"
        )
        for name, column in {**self.channels, TIME_BOUND: bound}.items():
            channel = described.append_child("channel")
            texts = {"label": name, "unit": column.unit, "type": "Force"}
            texts |= {"description": column.description}
            if column.per_tile:
                texts["serial"] = info.tiles[int(name.removeprefix(f"{column.name}_"))].serial
            for key, text in texts.items():
                channel.append_child_value(key, text)
        self._outlet = pylsl.StreamOutlet(stream, 0, _BUFFERED_S)

    def push(self, columns: Mapping[str, Array], at_s: Array, bound_s: Array) -> None:
        """Push samples at their instants."""
        samples = [
            to_floats_with_nan(column.name, columns[name]) for name, column in self.channels.items()
        ]
        self._outlet.push_chunk(np.stack([*samples, bound_s], axis=1), at_s.tolist())
