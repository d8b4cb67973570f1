"""`GET /metrics`: state of server and nodes in the text form of Prometheus.

Names, units and suffixes are those of its conventions (prometheus.io, "Metric and label naming").
All values are read when a scraper asks: without one it costs nothing. Counts of a node are those of
its present stream, and begin again with a new one, as after a restart of a process.
"""

from __future__ import annotations

import asyncio
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

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


class _NodeMetric(NamedTuple):
    """Metric with one value a node; None, as before the first frame, is left out."""

    kind: type[GaugeMetricFamily | CounterMetricFamily]
    name: str
    help_text: str
    read: Callable[[ServerNode], float | None]


_NODE_METRICS = (
    _NodeMetric(
        GaugeMetricFamily,
        "connected",
        "1 if the node is connected.",
        lambda node: node.is_connected,
    ),
    _NodeMetric(
        CounterMetricFamily,
        "received_frames",
        "Frames received, repeated ones included.",
        lambda node: node.received_frames,
    ),
    _NodeMetric(
        CounterMetricFamily,
        "received_bytes",
        "Bytes of received frames.",
        lambda node: node.received_bytes,
    ),
    _NodeMetric(
        GaugeMetricFamily,
        "frame_rate_hertz",
        "Sampled frames per second, over the last second.",
        lambda node: node.rate_hz if node.is_connected else 0.0,
    ),
    _NodeMetric(
        GaugeMetricFamily,
        "nominal_frame_rate_hertz",
        "Frames per second that the bus allows.",
        lambda node: node.last_info.nominal_rate_hz,
    ),
    _NodeMetric(
        CounterMetricFamily,
        "missed_slots",
        "Times at which the node sampled no frame, as it was late.",
        lambda node: node.present_stream.missed_slots,
    ),
    _NodeMetric(
        GaugeMetricFamily,
        "backlog_frames",
        "Frames that the node still has to send.",
        lambda node: node.present_stream_backlog_frames,
    ),
    _NodeMetric(
        GaugeMetricFamily,
        "backlog_bytes",
        "Bytes of these frames, by the mean of received ones.",
        lambda node: (
            node.present_stream_backlog_frames * node.received_bytes / node.received_frames
            if node.received_frames
            else None
        ),
    ),
    _NodeMetric(
        GaugeMetricFamily,
        "backlog_age_seconds",
        "Age of the oldest of these frames; 0: there are none.",
        lambda node: node.compute_backlog_age_s(server_utc_ns()),
    ),
    _NodeMetric(
        GaugeMetricFamily,
        "last_frame_age_seconds",
        "Time since the last frame was received.",
        lambda node: (
            (server_utc_ns() - node.last_seen_t_ns) * 1e-9
            if node.last_seen_t_ns is not None
            else None
        ),
    ),
    _NodeMetric(
        GaugeMetricFamily,
        "clock_offset_seconds",
        "Clock of the server minus clock of the node.",
        lambda node: (
            node.clock_offset.server_minus_node_ns * 1e-9 if node.clock_offset is not None else None
        ),
    ),
    _NodeMetric(
        GaugeMetricFamily,
        "clock_offset_bound_seconds",
        "Greatest error of this offset.",
        lambda node: (
            node.clock_offset.uncertainty_ns * 1e-9 if node.clock_offset is not None else None
        ),
    ),
    _NodeMetric(
        GaugeMetricFamily,
        "warnings",
        "Present warnings of the node.",
        lambda node: len(node.warnings),
    ),
    _NodeMetric(
        GaugeMetricFamily,
        "storage_failed",
        "1 if the server cannot store the node's frames.",
        lambda node: node.storage_problem is not None,
    ),
)


class _ServerCollector(Collector):
    """Metrics of one server and its nodes, at the time of the request."""

    def __init__(self, server: Server, disk: tuple[int, int, int] | None) -> None:
        self._server = server
        self._disk = disk

    def collect(self) -> Iterator[Metric]:
        yield from self._collect_server()
        nodes = list(self._server.nodes)
        for kind, name, help_text, read in _NODE_METRICS:
            metric = kind(f"foottile_node_{name}", help_text, labels=["node"])
            for node in nodes:
                if (value := read(node)) is not None:
                    metric.add_metric([node.name], value)
            yield metric
        lost = GaugeMetricFamily(
            "foottile_node_lost_frames", "Lost frames, by reason.", labels=["node", "reason"]
        )
        faults = CounterMetricFamily(
            "foottile_node_tile_faults",
            "Faulty readings of a tile, by reason.",
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
