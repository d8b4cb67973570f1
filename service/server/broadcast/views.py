"""Present state of nodes, tares and sessions in the JSON shapes of the API."""

from __future__ import annotations

import math
from typing import Any, Generic, TypeVar

import numpy as np
from pydantic import Field

from devices.arrays import Floats
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.estimation.compilation import is_compiling
from service.estimation.tare.tare import (
    compute_sealed_gas_shift_kpa,
    compute_warming_k,
    fit_recent_baseline_trend,
)
from service.protocol.live import (
    CalibrationView,
    ClockView,
    DriftView,
    NodeCounts,
    NodeView,
    ReplacementView,
    SessionProgress,
    SessionView,
    TareView,
    TileView,
    View,
)
from service.server.estimates.live_estimator import TileRanges
from service.server.node import ServerNode
from service.server.nodes import RefusedMachine
from service.server.recorder import Recorder
from service.server.session_store import marker_revision, user_fields_revision
from service.sessions.tares import RecordedTare
from storage.sessions.folder import Ledger, Marker, Session

T = TypeVar("T")


class Page(View, Generic[T]):
    """Page of a list."""

    items: list[T]
    next_cursor: str | None = Field(
        default=None, description="Value of `?cursor=` for the next page; null: this is the last."
    )


class TaresPage(Page[TareView]):
    """History of a node's tares, and the drift of its baselines."""

    drift: DriftView


class MarkerView(View):
    """Marker of a session."""

    id: str
    label: str
    t_ns: int = Field(description="Server's UTC.")
    stream_id: str | None = Field(
        description="Stream of an edge of a sync line; null: a person set the marker."
    )
    t_mono_ns: int | None = Field(description="Instant of an edge by its node's clock.")
    bound_ns: int | None = Field(
        description="Bound of the error of an edge's `t_ns`; null: that is its node's UTC."
    )
    revision: str = Field(description="Its revision, for `If-Match`.")


def make_marker_view(marker: Marker) -> MarkerView:
    """Return a marker of a session."""
    return MarkerView(**vars(marker), revision=marker_revision(marker))


def make_tare_view(recorded: RecordedTare) -> TareView:
    """Return a tare of the history."""
    content = recorded.tare.as_dict()
    return TareView(
        id=recorded.id,
        undone=recorded.undone,
        reason=recorded.reason,
        **{name: content[name] for name in TareView.model_fields if name in content},
    )


def make_drift_view(node: ServerNode) -> DriftView:
    """Return the present drift of a node."""
    live, tiles = node.estimator.live, len(node.last_info.tiles)
    line = fit_recent_baseline_trend(
        node.estimator.tare_history.valid_tares(node.last_info),
        counts_per_kelvin=live.counts_per_kelvin,
    )
    unknown = np.full(tiles, np.nan)
    slope = unknown if live.ranges is None else live.ranges.slope_n_per_kpa
    warmer_by_k = since_kpa = unknown
    if (tare := live.tare_in_use_unless_lost) is not None:
        recent_raw = live.mean_recent_temperature_raw()
        warmer_by_k = compute_warming_k(tare, recent_raw, live.counts_per_kelvin)
        since_kpa = compute_sealed_gas_shift_kpa(tare, warmer_by_k)
    # A bare tile has no sealed gas.
    since_kpa = np.where([tile.reference for tile in node.last_info.tiles], np.nan, since_kpa)
    return DriftView(
        kpa_per_hour=_nan_to_none(line.kpa_per_hour),
        sigma_kpa_per_hour=_nan_to_none(line.sigma_kpa_per_hour),
        n_per_hour=_nan_to_none(line.kpa_per_hour * slope),
        grf_n_per_hour=live.grf_shift_n(line.kpa_per_hour),
        kelvin_per_hour=_nan_to_none(line.kelvin_per_hour),
        kelvin_since_tare=_nan_to_none(warmer_by_k),
        kpa_since_tare=_nan_to_none(since_kpa),
        grf_n_since_tare=live.grf_shift_n(since_kpa),
    )


def make_node_counts(node: ServerNode) -> NodeCounts:
    """Return the present rate and losses of a node."""
    return NodeCounts(**_list_count_fields(node, node.present_stream_lost_by_reason))


def _list_count_fields(node: ServerNode, lost: dict[str, int]) -> dict[str, Any]:
    return {
        "connected": node.is_connected,
        "rate_hz": node.rate_hz if node.is_connected else None,
        "lost_frames": sum(lost.values()),
        "backlog_frames": node.present_stream_backlog_frames,
        "missed_slots": node.present_stream.missed_slots,
        "last_seq": node.last_seq,
    }


def make_calibration_view(
    calibration: Calibration | None, calibration_id: str | None, ranges: TileRanges | None
) -> CalibrationView | None:
    """Return a calibration in use; None: there is none, or it is of other tiles."""
    if calibration is None or calibration_id is None or ranges is None:
        return None
    return CalibrationView(
        id=calibration_id,
        name=calibration.name,
        absolute_scale="assumed" if ranges.is_scale_assumed else "measured",
    )


def make_node_view(
    node: ServerNode, recorder: Recorder, replacement: RefusedMachine | None
) -> NodeView:
    """Return the present state of a node."""
    info, estimates = node.last_info, node.estimator
    live, controller = estimates.live, estimates.tare_controller
    lost = node.present_stream_lost_by_reason
    tare = estimates.tare_history.tare_in_force_unless_lost(info)
    return NodeView(
        **_list_count_fields(node, lost),
        node=node.name,
        stream_id=node.stream_id,
        scene=info.scene,
        emulated=node.hello.emulated,
        tiles=make_tile_views(info, live.ranges),
        servo=info.servo,
        schedule=info.schedule,
        nominal_rate_hz=info.nominal_rate_hz,
        calibration=make_calibration_view(live.calibration, live.calibration_id, live.ranges),
        calibration_source=estimates.calibration_source,
        calibration_problem=estimates.calibration_problem,
        tare=make_tare_view(tare) if tare is not None else None,
        tare_problem=controller.missing_tare_reason,
        tare_warnings=controller.list_reasons_to_tare_again(),
        auto_tare=controller.auto_tare_state,
        drift=make_drift_view(node),
        storage_problem=node.storage_problem,
        clock=None if node.clock_offset is None else ClockView.model_validate(node.clock_offset),
        clock_set=info.clock_set,
        lost=lost,
        warnings=[*node.warnings, *node.refused_ahead_frames_warnings],
        compiling=is_compiling(),
        fault_counts=node.fault_counts,
        vitals=node.vitals,
        last_t_ns=node.last_t_ns,
        last_seen_t_ns=node.last_seen_t_ns,
        recording=[session.id for session in recorder.list_recording(node.name)],
        replacement=None
        if replacement is None
        else ReplacementView.model_validate(replacement),  # without the secret
    )


def make_session_view(session: Session, recorder: Recorder) -> SessionView:
    """Return the present state of a session."""
    ledger = recorder.compute_ledger(session)
    content = session.model_dump(include=set(SessionView.model_fields))
    content |= _list_progress_fields(session, ledger, recorder)
    content |= {
        "complete": ledger.completeness,
        "marker_count": len(session.markers),
        "revision": user_fields_revision(session),
        "max_lost_tail_frames": ledger.max_lost_tail_frames,
        "problem": recorder.find_problem_to_show(session),
    }
    return SessionView(**content)


def make_session_progress(session: Session, recorder: Recorder) -> SessionProgress:
    """Return the present progress of a session; coarse, so that it seldom changes."""
    fields = _list_progress_fields(session, recorder.compute_ledger(session), recorder)
    coarse = {"duration_s": 1, "not_sampled_share": 3}
    return SessionProgress(**fields | {name: round(fields[name], n) for name, n in coarse.items()})


def _list_progress_fields(session: Session, ledger: Ledger, recorder: Recorder) -> dict[str, Any]:
    return {
        "frames": ledger.recorded,
        "pending_frames": ledger.pending,
        "pending_reason": recorder.find_pending_reason(session, ledger),
        "lost": ledger.lost,
        "missed_slots": ledger.missed_slots,
        "not_sampled_share": ledger.not_sampled_share,
        "duration_s": recorder.compute_duration_s(session, ledger.recorded),
    }


def make_tile_views(info: ArrayInfo, ranges: TileRanges | None) -> list[TileView]:
    """Return the tiles of an array; without a calibration their ranges are null."""
    nones = [None] * len(info.tiles)
    full_scales = nones if ranges is None else _nan_to_none(ranges.full_scale_n)
    entries = nones if ranges is None else ranges.entries
    placed = {"serial", "mux", "channel", "x_m", "y_m", "z_m", "reference"}
    return [
        TileView(
            range_kpa=entry.range_kpa if entry is not None else None,
            full_scale_n=full_scale_n,
            **tile.model_dump(include=placed),
        )
        for tile, entry, full_scale_n in zip(info.tiles, entries, full_scales, strict=True)
    ]


def _nan_to_none(values: Floats) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values.tolist()]
