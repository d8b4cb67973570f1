"""`GET /metrics`: state of server and nodes in the text form of Prometheus.

Names, units and suffixes are those of its conventions (prometheus.io, "Metric and label naming").
All values are read when a scraper asks: without one it costs nothing. Received frames and bytes
count from the server's start; other counts of a node are those of its present stream. Of a node
that is away, backlog, clock, warnings and vitals are unknown, and left out.
"""

from __future__ import annotations

import asyncio
import shutil
from collections import Counter
from collections.abc import Iterator

from fastapi import APIRouter, Request, Response
from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    Metric,
    SummaryMetricFamily,
)
from prometheus_client.registry import Collector

from devices.clock import server_utc_ns
from service.api.routes.common import ServerState
from service.server.node import ServerNode
from service.server.server import Server
from service.version import SOFTWARE_VERSION

router = APIRouter(tags=["server"])


@router.get("/metrics", summary="Metrics for Prometheus", response_class=Response)
async def get_metrics(request: Request, server: ServerState) -> Response:
    """Return state of server and nodes, in the text form that the request accepts."""
    try:
        disk = await asyncio.to_thread(shutil.disk_usage, server.data)
    except OSError:  # the folder is away: `foottile_node_storage_failed` tells
        disk = None
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    registry.register(_ServerCollector(server, disk))
    encode, media_type = choose_encoder(request.headers.get("accept", ""))
    return Response(encode(registry), media_type=media_type)


_Value = tuple[str, float | None]
"""Help text and value; None, as before the first frame, is left out."""


def _list_node_values(node: ServerNode) -> dict[str, _Value]:
    """Return the values of a node by the metric's name; counters end in `_total`."""
    now_t_ns, is_here = server_utc_ns(), node.is_connected
    clock = node.clock_offset if is_here else None
    backlog = node.present_stream_backlog_frames if is_here else None
    backlog_age_s = node.compute_backlog_age_s(now_t_ns) if is_here else None
    frame_bytes = node.received_bytes / node.received_frames if node.received_frames else None
    silent_ns = None if node.last_seen_t_ns is None else now_t_ns - node.last_seen_t_ns
    backlog_bytes = None if backlog is None or frame_bytes is None else backlog * frame_bytes
    rate_hz = node.rate_hz if is_here else 0.0
    return {
        "connected": ("1 if the node is connected.", is_here),
        "received_frames_total": ("Frames received, repeated ones, too.", node.received_frames),
        "received_bytes_total": ("Bytes of received frames.", node.received_bytes),
        "frame_rate_hertz": ("Sampled frames per second, over the last second.", rate_hz),
        "nominal_frame_rate_hertz": ("Rate that the bus allows.", node.last_info.nominal_rate_hz),
        "missed_slots_total": ("Frames not sampled: too late.", node.present_stream.missed_slots),
        "backlog_frames": ("Frames that the node still has to send.", backlog),
        "backlog_bytes": ("Their bytes, by the mean.", backlog_bytes),
        "backlog_age_seconds": ("Age of the oldest.", backlog_age_s),
        "last_frame_age_seconds": ("Time since a frame.", silent_ns and silent_ns * 1e-9),
        "clock_offset_seconds": (
            "Clock of the server minus clock of the node.",
            None if clock is None else clock.server_minus_node_ns * 1e-9,
        ),
        "clock_offset_bound_seconds": (
            "Greatest error of this offset.",
            None if clock is None else clock.uncertainty_ns * 1e-9,
        ),
        "warnings": ("Present warnings of the node.", len(node.warnings) if is_here else None),
        "storage_failed": ("1: its frames cannot be stored.", node.storage_problem is not None),
    } | {
        f"vitals_{name}": (f"{title}; of the node's machine.", getattr(node.vitals, field, None))
        for name, field, title in _VITALS
    }


_VITALS = (
    ("disk_free_bytes", "disk_free_bytes", "Free disk"),
    ("cpu_celsius", "cpu_celsius", "Temperature of the CPU"),
    ("undervolted", "is_undervolted", "1: the supply is too low"),
    ("throttled", "is_throttled", "1: the CPU is slowed down"),
    ("wifi_signal_dbm", "wifi_dbm", "Signal of the Wi-Fi"),
)
"""Metric, field of `Vitals`, and title."""


class _ServerCollector(Collector):
    """Metrics of one server and its nodes, at the time of the request."""

    def __init__(self, server: Server, disk: tuple[int, int, int] | None) -> None:
        self._server = server
        self._disk = disk

    def collect(self) -> Iterator[Metric]:
        yield from self._collect_server()
        nodes = list(self._server.nodes)
        metrics: dict[str, GaugeMetricFamily | CounterMetricFamily] = {}
        for node in nodes:
            for name, (help_text, value) in _list_node_values(node).items():
                kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
                new = kind(f"foottile_node_{name}", help_text, labels=["node"])
                metric = metrics.setdefault(name, new)
                if value is not None:
                    metric.add_metric([node.name], value)
        yield from metrics.values()
        lost = GaugeMetricFamily(
            "foottile_node_lost_frames", "Lost frames, by reason.", labels=["node", "reason"]
        )
        faults = CounterMetricFamily(
            "foottile_node_tile_faults",
            "Faulty readings of a tile, or dropped edges of `sync`, by reason.",
            labels=["node", "tile", "reason"],
        )
        for node in nodes:
            for reason, count in node.present_stream_lost_by_reason.items():
                lost.add_metric([node.name, reason], count)
            for serial, counts in node.fault_counts.items():
                for reason, count in counts.items():
                    faults.add_metric([node.name, serial, reason], count)
        yield from (lost, faults)

    def _collect_server(self) -> Iterator[Metric]:
        server = self._server
        info = GaugeMetricFamily("foottile_info", "1, with the version.", labels=["version"])
        info.add_metric([SOFTWARE_VERSION.rsplit(" ", 1)[1]], 1)
        yield info
        yield GaugeMetricFamily(
            "foottile_viewers", "Live pages and programs.", server.broadcaster.subscriber_count
        )
        sessions = GaugeMetricFamily(
            "foottile_unsealed_sessions", "Sessions that are not sealed.", labels=["state"]
        )
        for state, count in Counter(one.state for one in server.sessions.list_unsealed()).items():
            sessions.add_metric([state], count)
        yield sessions
        yield SummaryMetricFamily(
            "foottile_sync_seconds",
            "Time to sync received frames to the disk.",
            count_value=server.sync_count,
            sum_value=server.sync_total_s,
        )
        yield GaugeMetricFamily(
            "foottile_file_problems",
            "Damages found in the data folder.",
            len(server.file_problems),
        )
        if self._disk is not None:
            size_bytes, _, free_bytes = self._disk
            yield GaugeMetricFamily(
                "foottile_disk_size_bytes", "Size of the data folder's disk.", size_bytes
            )
            yield GaugeMetricFamily(
                "foottile_disk_free_bytes", "Bytes free on the data folder's disk.", free_bytes
            )
