"""Estimation of one node over all its streams: calibration, tares, live estimator.

A node sends its own calibration with hello. An assigned one replaces it, from the next frame on and
for sessions that begin then, until it is unassigned; it is a copy, stored with the node. If the
file is damaged, the assigned calibration is unknown: then the node has none, rather than another
one.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from devices.errors import StorageError
from devices.frames import ArrayInfo, FrameBatch
from service.estimation.calibration import Calibration
from service.estimation.records import ColumnDict
from service.protocol.link import Hello
from service.server.calibrations import CalibrationAssignment
from service.server.estimates.live_estimator import EpochHistory, EstimateEpoch, LiveEstimator
from service.server.estimates.tare_controller import TareController
from service.sessions.tares import TareHistory
from storage.intervals import Intervals
from storage.journal.journal import Journal

log = logging.getLogger("foottile.nodes")

EstimatedBatch = tuple[FrameBatch, ColumnDict]
"""Frames with their estimates by column; no columns without estimates."""
_ENDED_STREAMS_MAX = 16
"""Number of ended streams whose epochs are kept."""


class NodeEstimator:
    """Estimator of a node's present stream; a bug there costs its estimates only.

    Args:
        folder: files of the node: its tares, and the calibration assigned here.
        hello: last hello of the node.
    """

    def __init__(self, folder: Path, hello: Hello) -> None:
        self.tare_history = TareHistory(folder / "tares.json")
        self.assignment = CalibrationAssignment(folder / "assigned.json")
        self.live = LiveEstimator(hello.array_info, None, None)
        self.tare_controller: TareController
        self._hello = hello
        self._has_failed = False
        self._ended_epochs: OrderedDict[str, EpochHistory] = OrderedDict()
        """Epochs of streams before the present one; only the newest of these has states."""
        self._restart()

    @property
    def last_info(self) -> ArrayInfo:
        """Array of the present stream, from the last hello."""
        return self._hello.array_info

    @property
    def file_problems(self) -> list[str]:
        """Damage found in the files, and the consequence, as text."""
        texts = (self.tare_history.problem, self.assignment.problem)
        return [problem for problem in texts if problem is not None]

    @property
    def assigned_or_node_calibration(self) -> Calibration | None:
        """Calibration to use for its tiles: the assigned one, else the node's own.

        It may not fit them; the calibration in use is `live.calibration`.
        """
        if self.assignment.problem is not None:
            return None
        assigned = self.assignment.current
        return self._hello.calibration if assigned is None else assigned.calibration

    @property
    def calibration_source(self) -> Literal["node", "server"]:
        """Origin of `assigned_or_node_calibration`."""
        chosen = self.assignment.current is not None or self.assignment.problem is not None
        return "server" if chosen else "node"

    @property
    def calibration_problem(self) -> str | None:
        """Reason why no calibration is in use."""
        node_problem = (
            self._hello.calibration_problem if self.calibration_source == "node" else None
        )
        return self.assignment.problem or self.live.calibration_problem or node_problem

    def epochs_since_server_start(self, stream_id: str) -> list[EstimateEpoch]:
        """Return the epochs of a stream since the server was started, in order."""
        if stream_id == self.live.info.stream_id:
            return self.live.epochs.list_epochs()
        ended = self._ended_epochs.get(stream_id)
        return [] if ended is None else ended.list_epochs()

    def store_and_apply_calibration(self, calibration: Calibration | None, t_ns: int) -> None:
        """Store the assigned calibration, and use it from the next frame on.

        Sessions that are being recorded keep theirs.

        Args:
            calibration: calibration to use; None: the node's own again.
            t_ns: the server's UTC.

        Raises:
            StorageError: that cannot be stored; nothing has changed then.
        """
        self.assignment.store_assignment(calibration, t_ns)
        before = self.live
        self._restart()
        try:
            self.live.drain_frames_from(before)
        except Exception as error:
            self._disable(error)

    def restart_if_changed(self, hello: Hello) -> None:
        """Restart the estimator if hello has another stream or calibration."""
        previous, self._hello = self._hello, hello
        if previous.array_info.stream_id != hello.array_info.stream_id:
            for history in self._ended_epochs.values():
                history.drop_states()
            self._ended_epochs[previous.array_info.stream_id] = self.live.epochs
            if len(self._ended_epochs) > _ENDED_STREAMS_MAX:
                self._ended_epochs.popitem(last=False)
        is_same = (previous.array_info, previous.calibration) == (
            hello.array_info,
            hello.calibration,
        )
        if not is_same or self._has_failed:
            self._restart()

    def estimate_or_pass_frames(self, frames: FrameBatch) -> list[EstimatedBatch]:
        """Add the next frames of the present stream; return those whose estimates are due."""
        try:
            return list(self.live.estimate_or_pass_frames(frames))
        except Exception as error:
            self._disable(error)
            return [(frames, {})]

    def store_lead_or_flight_tare_if_due(
        self, journal: Journal | None, get_obtainable: Callable[[], Intervals]
    ) -> None:
        """Tare if there is reason to, as `TareController.store_lead_or_flight_tare_if_due`.

        Raises:
            StorageError: the tare cannot be stored; it is not in force then, and retried.
        """
        try:
            self.tare_controller.store_lead_or_flight_tare_if_due(journal, get_obtainable)
        except StorageError:
            raise
        except Exception as error:
            self._disable(error)

    def _restart(self) -> None:
        self._has_failed = False
        try:
            tare = self.tare_history.tare_in_force_or_lost(self.last_info)
            self.live = LiveEstimator(
                self.last_info, self.assigned_or_node_calibration, tare, self.live
            )
        except Exception as error:
            self._disable(error)
            return
        automatic = self._hello.scene.get("auto_tare", True) is not False
        self.tare_controller = TareController(
            self.last_info, self.live, self.tare_history, automatic=automatic
        )

    def _disable(self, error: Exception) -> None:
        node = self.last_info.node
        log.exception("node %s: this is a bug; it goes on without estimates", node)
        self._has_failed = True
        self.live = LiveEstimator(self.last_info, None, None, self.live)
        self.live.calibration_problem = f"the estimator failed, until it connects again: {error!r}"
        self.tare_controller = TareController(
            self.last_info, self.live, self.tare_history, automatic=False
        )
