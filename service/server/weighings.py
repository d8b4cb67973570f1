"""Guided calibrations with known weights: one per node, recorded, marked and fitted here.

The frames go into a session, in which markers say which weight stood on which tile; a fit of the
server reads it, as it reads any test-rig recording. So `foottile calibrate SESSION` computes the
same numbers later. Markers have the instants of the frames that were watched, not of their arrival.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Literal

from devices.chips.pressure_chips import Compensation
from devices.errors import CalibrationError, FootTileError, StateError, UnknownError, UsageError
from devices.frames import FrameBatch
from service.estimation.calibration import Calibration
from service.server.calibrations import (
    FRAMES_MAX,
    CalibrationJob,
    CalibrationJobs,
    CalibrationStore,
)
from service.server.estimates.node_estimator import EstimatedBatch
from service.server.node import ServerNode
from service.server.recorder import Recorder
from service.server.session_store import SessionStore, check_revision
from service.server.weighing import Begin, End, MarkerChange, Method, Weighing, Withdraw
from storage.sessions.folder import FRAMES_NAME, Session

log = logging.getLogger("foottile.weighings")

IDLE_S = 600.0
"""Longest time without a completed step before a weighing ends."""
AWAY_S = 30.0
"""Longest silence of a node before its weighing ends."""
_SEAL_S = 300.0
_LOOK_S = 0.2
_WEIGHT_S = 30.0  # least time that a weight takes a person

WeighingState = Literal["weighing", "fitting", "done", "failed"]


@dataclass(frozen=True)
class WeighingPlan:
    """Tiles and weights of a guided calibration.

    Attributes:
        tiles: serials, in the order in which they are loaded.
        weights: as markers have them.
        method: reference of the force.
        reference: the reference in words, for the calibration.
        name: of the calibration.
    """

    tiles: tuple[str, ...]
    weights: tuple[str, ...]
    method: Method
    reference: str
    name: str


@dataclass
class NodeWeighing:
    """The guided calibration of a node, under way or ended."""

    plan: WeighingPlan
    session_id: str
    """Session of the recording; also identifies the weighing."""
    stream_id: str
    passes: list[Weighing]
    """One per tile."""
    progress_s: float
    """When the last step was completed; monotonic."""
    seen_s: float
    """When the last frames came; monotonic."""
    at: int = 0
    """Index of the tile under way."""
    state: WeighingState = "weighing"
    warning: str | None = None
    """Why the last step is repeated."""
    problem: str | None = None
    """Why it failed."""
    calibration: Calibration | None = None
    markers: list[tuple[str, bool]] = field(default_factory=list)
    """Ids of markers, and whether each begins a step."""
    task: asyncio.Task[None] | None = None
    """Seals and fits."""

    @property
    def present_tile_pass(self) -> Weighing:
        """The pass under way, or the last one."""
        return self.passes[self.at]


class Weighings:
    """Guided calibrations of a server, for use in the server's event loop only.

    Args:
        sessions: store of the recordings.
        recorder: starts, stops and seals recordings.
        fits: jobs that fit recordings.
        calibrations: store of the fitted calibrations.
    """

    def __init__(
        self,
        sessions: SessionStore,
        recorder: Recorder,
        fits: CalibrationJobs,
        calibrations: CalibrationStore,
    ) -> None:
        self._sessions = sessions
        self._recorder = recorder
        self._fits = fits
        self._calibrations = calibrations
        self._of: dict[str, NodeWeighing] = {}

    def find(self, node: str) -> NodeWeighing | None:
        """Return a node's weighing, under way or the last to end; None if there was none."""
        return self._of.get(node)

    def get(self, node: str, session_id: str | None = None) -> NodeWeighing:
        """Return the weighing of a node.

        Args:
            node: its name.
            session_id: id that the weighing must have; None: any.

        Raises:
            UnknownError: the node has no weighing.
            ChangedError: the weighing has another id.
        """
        found = self._of.get(node)
        if found is None:
            raise UnknownError(
                f"no guided calibration on node {node!r}",
                remedy="Start one, on the page /calibrate",
            )
        check_revision(session_id, found.session_id, f"the guided calibration of {node!r}")
        return found

    def start_with_recording(self, node: ServerNode, plan: WeighingPlan) -> NodeWeighing:
        """Start a recording, and the guided calibration of the first tile in it.

        Raises:
            StateError: one is under way on this node, or the node cannot be recorded now.
            UsageError: no such tile, or more tiles than a fit takes.
            StorageError: the recording cannot be written down.
        """
        before = self._of.get(node.name)
        if before is not None and before.state in ("weighing", "fitting"):
            raise StateError(
                f"tiles of node {node.name!r} are being calibrated by somebody",
                remedy="Follow it on the page /calibrate, or cancel it there",
            )
        bearing = [tile.serial for tile in node.last_info.tiles if not tile.reference]
        for serial in plan.tiles:
            if serial not in bearing:
                raise UsageError(
                    f"node {node.name!r} has no tile {serial[:40]} that bears load",
                    expected=f"one of {', '.join(bearing)}",
                )
        if len(set(plan.tiles)) < len(plan.tiles):
            raise UsageError("a tile is named twice", remedy="Name each once")
        lasts_s = _WEIGHT_S * len(plan.tiles) * len(plan.weights)
        if lasts_s * node.last_info.nominal_rate_hz > FRAMES_MAX:
            raise UsageError(
                f"{len(plan.weights)} weights on {len(plan.tiles)} tiles take {lasts_s / 60:.0f} "
                "minutes or more: their recording is too long for one fit",
                expected=f"at most {FRAMES_MAX} frames",
                remedy="Calibrate fewer tiles at once",
            )
        if node.is_connected and node.clock_offset is None:
            raise StateError(
                f"the clock of node {node.name!r} was not compared with the server's yet",
                remedy="Start again in some seconds",
            )
        session = self._recorder.start_session(
            node.name, f"weights on {', '.join(plan.tiles)}"[:200], tags=("calibration",)
        )
        now_s = time.monotonic()
        self._of[node.name] = NodeWeighing(
            plan=plan,
            session_id=session.id,
            stream_id=node.stream_id,
            passes=[Weighing(serial, plan.weights, plan.method) for serial in plan.tiles],
            progress_s=now_s,
            seen_s=now_s,
        )
        return self._of[node.name]

    def feed_frames(self, node: ServerNode, batches: Sequence[EstimatedBatch]) -> None:
        """Feed the newest frames of a node to its weighing; cheap if there is none."""
        weighing = self._of.get(node.name)
        if weighing is None or node.stream_id != weighing.stream_id:
            return
        for frames, _ in batches:
            if weighing.state == "weighing" and len(frames):
                with self._failing(weighing):
                    self._take(weighing, node, frames)

    def repeat_held_or_last_weight(
        self, node: ServerNode, session_id: str | None = None
    ) -> NodeWeighing:
        """Go back to the weight that is held, or else to the last one on this tile.

        Raises:
            UnknownError, ChangedError: as `get`.
            StateError: it is not under way.
            StorageError: the markers cannot be removed.
        """
        weighing = self.get(node.name, session_id)
        if weighing.state != "weighing":
            raise StateError(
                f"the guided calibration of {node.name!r} has ended", remedy="Start another one"
            )
        self._mark(weighing, node, weighing.present_tile_pass.repeat_held_or_last_weight())
        return weighing

    async def cancel_or_remove_weighing(self, node: str, session_id: str | None = None) -> None:
        """Cancel the weighing of a node and stop its recording, or remove one that has ended.

        Raises:
            UnknownError, ChangedError: as `get`.
        """
        weighing = self.get(node, session_id)
        del self._of[node]
        await self._cancel(weighing)

    def fail_if_stalled_or_interrupted(self, node: ServerNode, now_s: float) -> None:
        """End, as failed, the weighing of a node without progress, frames or recording.

        Args:
            node: of the server.
            now_s: monotonic.
        """
        weighing = self._of.get(node.name)
        if weighing is None or weighing.state != "weighing":
            return
        with self._failing(weighing):
            if node.stream_id != weighing.stream_id:
                raise StateError(
                    f"node {node.name!r} was restarted", remedy="Repeat: begin with the first rest"
                )
            if self._sessions.get_session(weighing.session_id).state != "recording":
                raise StateError(
                    "its recording was stopped", remedy="Repeat, and leave the recording alone"
                )
            if now_s - weighing.seen_s > AWAY_S:
                raise StateError(
                    f"node {node.name!r} has sent nothing for {AWAY_S:.0f} s",
                    remedy="Repeat when it is connected again",
                )
            if now_s - weighing.progress_s > IDLE_S:
                raise StateError(
                    f"no step was completed for {IDLE_S / 60:.0f} minutes",
                    remedy="Repeat when you are at the foot",
                )

    async def close(self) -> None:
        """Cancel all weighings, as the server ends."""
        await asyncio.gather(*(self._cancel(weighing) for weighing in self._of.values()))

    def _take(self, weighing: NodeWeighing, node: ServerNode, frames: FrameBatch) -> None:
        weighing.seen_s = time.monotonic()
        i = node.last_info.serials.index(weighing.present_tile_pass.serial)
        kpa = Compensation(node.last_info.tiles).compute_usable_kpa(frames)[:, i]
        self._mark(weighing, node, weighing.present_tile_pass.feed_tile_pressures(frames.t_ns, kpa))
        if weighing.present_tile_pass.step != "done":
            return
        if weighing.at + 1 < len(weighing.passes):
            weighing.at += 1
        else:
            weighing.state = "fitting"
            weighing.task = asyncio.get_running_loop().create_task(self._finish(weighing))

    def _mark(
        self, weighing: NodeWeighing, node: ServerNode, actions: Sequence[MarkerChange]
    ) -> None:
        """Write the steps as markers of the session, and remove those of withdrawn steps."""
        for action in actions:
            match action:
                case Begin(label, t_ns):
                    event = self._sessions.add_marker(
                        weighing.session_id, label, node.to_server_t_ns_or_unchanged(t_ns)
                    )
                    weighing.markers.append((event.id, True))
                case End(t_ns):
                    event = self._sessions.add_marker(
                        weighing.session_id, "end", node.to_server_t_ns_or_unchanged(t_ns)
                    )
                    weighing.markers.append((event.id, False))
                    weighing.progress_s, weighing.warning = time.monotonic(), None
                case Withdraw(reason):
                    weighing.warning = reason
                    while weighing.markers:
                        marker_id, is_begin = weighing.markers.pop()
                        with suppress(UnknownError):  # a person was quicker
                            self._sessions.remove_marker(weighing.session_id, marker_id)
                        if is_begin:
                            break

    async def _finish(self, weighing: NodeWeighing) -> None:
        """Seal the recording and fit it."""
        with self._failing(weighing):
            self._recorder.stop_session(weighing.session_id)
            session = await self._recorder.wait_until_sealed_or_timeout(
                weighing.session_id, _SEAL_S
            )
            if session.state != "sealed":
                raise StateError(
                    f"the recording is not sealed: {self._why_not(session)}",
                    remedy="Once it is, fit it with `foottile calibrate`",
                )
            fit = await self._fit(weighing)
            if fit.calibration_id is None:
                file = self._sessions.folder.get_path(weighing.session_id) / FRAMES_NAME
                problem = fit.problem or f"the fit was {fit.state}"
                raise CalibrationError(problem.replace(f"{file}, ", ""))
            weighing.calibration = await asyncio.to_thread(
                self._calibrations.load, fit.calibration_id
            )
            weighing.state = "done"

    async def _fit(self, weighing: NodeWeighing) -> CalibrationJob:
        """Fit the recording, after the fits of others."""
        while self._fits.is_busy:
            await asyncio.sleep(_LOOK_S)
        plan = weighing.plan
        fit = self._fits.start_job(plan.name, [weighing.session_id], {"sensor": plan.reference})
        try:
            while fit.state == "running":
                await asyncio.sleep(_LOOK_S)
        except asyncio.CancelledError:
            await self._fits.cancel_job(fit.id)
            raise
        return fit

    def _why_not(self, session: Session) -> str:
        ledger = self._recorder.compute_ledger(session)
        return self._recorder.find_problem_to_show(session) or (
            f"the node still has {ledger.pending} frames of it"
        )

    async def _cancel(self, weighing: NodeWeighing) -> None:
        if weighing.task is not None:
            weighing.task.cancel()
            await asyncio.gather(weighing.task, return_exceptions=True)
        if weighing.state == "weighing":
            self._stop(weighing)

    @contextmanager
    def _failing(self, weighing: NodeWeighing) -> Iterator[None]:
        """Context manager: an error ends the weighing only."""
        try:
            yield
        except Exception as error:
            weighing.problem = str(error)
            if not isinstance(error, FootTileError):
                log.exception("weighing %s: this is a bug", weighing.session_id)
                weighing.problem = f"the server made a mistake: {error!r}"
            weighing.state = "failed"
            self._stop(weighing)

    def _stop(self, weighing: NodeWeighing) -> None:
        """End the recording, if it goes on."""
        try:
            self._recorder.stop_session(weighing.session_id)
        except FootTileError as error:
            log.warning("session %s: %s", weighing.session_id, error)
