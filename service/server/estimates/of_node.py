"""Estimation of one node over all its streams: calibration, tares, live estimator."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from devices.errors import StorageError
from devices.frames import ArrayInfo, FrameBatch
from service.estimation.calibration import Calibration
from service.link import Hello
from service.server.estimates.assignment import Assignment
from service.server.estimates.live import Begun, LiveEstimates
from service.server.estimates.tare_keeper import TareKeeper
from service.sessions.pipeline import Columns
from service.sessions.tares import TareHistory
from storage.intervals import Intervals
from storage.journal.journal import Journal

log = logging.getLogger("foottile.nodes")

Estimated = tuple[FrameBatch, Columns]
"""Frames with their estimates by column; no columns without estimates."""
_ENDED_MAX = 16
"""Number of ended streams whose epochs are kept."""


class NodeEstimates:
    """Estimator of a node's present stream; a bug there costs its estimates only.

    Args:
        folder: files of the node: its tares, and the calibration assigned here.
        hello: last hello of the node.
    """

    def __init__(self, folder: Path, hello: Hello) -> None:
        self.tares = TareHistory(folder / "tares.json")
        self.assignment = Assignment(folder / "assigned.json")
        self.live = LiveEstimates(hello.array_info, None, None)
        self.tare_keeper: TareKeeper
        self._hello = hello
        self._has_failed = False
        self._begun: OrderedDict[str, tuple[Begun, ...]] = OrderedDict()
        """Epochs of streams before the present one."""
        self._begin()

    @property
    def info(self) -> ArrayInfo:
        """Array of the present stream."""
        return self._hello.array_info

    @property
    def damages(self) -> list[str]:
        """Damage found in the files, and the consequence, as text."""
        texts = (self.tares.problem, self.assignment.problem)
        return [problem for problem in texts if problem is not None]

    @property
    def calibration(self) -> Calibration | None:
        """Calibration to use for its tiles: the assigned one, else the node's own.

        It may not fit them; the calibration in use is `live.calibration`.
        """
        if self.assignment.problem is not None:
            return None
        assigned = self.assignment.present
        return self._hello.calibration if assigned is None else assigned.calibration

    @property
    def calibration_source(self) -> Literal["node", "server"]:
        """Origin of `calibration`."""
        chosen = self.assignment.present is not None or self.assignment.problem is not None
        return "server" if chosen else "node"

    @property
    def calibration_problem(self) -> str | None:
        """Reason why no calibration is in use."""
        node_problem = (
            self._hello.calibration_problem if self.calibration_source == "node" else None
        )
        return self.assignment.problem or self.live.calibration_problem or node_problem

    def begun(self, boot_id: str) -> tuple[Begun, ...]:
        """Return the epochs of a stream since the server was started, in order."""
        if boot_id == self.live.info.boot_id:
            return tuple(self.live.begun)
        return self._begun.get(boot_id, ())

    def use_calibration(self, calibration: Calibration | None, t_ns: int) -> None:
        """Assign a calibration, used from the next frame on.

        Sessions that are being recorded keep theirs.

        Args:
            calibration: calibration to use; None: the node's own again.
            t_ns: the server's UTC.

        Raises:
            StorageError: that cannot be stored; nothing has changed then.
        """
        if calibration is None:
            self.assignment.take_back(t_ns)
        else:
            self.assignment.put(calibration, t_ns)
        before = self.live
        self._begin()
        try:
            self.live.go_on_from(before)
        except Exception as error:
            self._go_without(error)

    def greet(self, hello: Hello) -> None:
        """Restart the estimator if hello has another stream or calibration."""
        previous, self._hello = self._hello, hello
        if previous.array_info.boot_id != hello.array_info.boot_id:
            self._begun[previous.array_info.boot_id] = tuple(self.live.begun)
            if len(self._begun) > _ENDED_MAX:
                self._begun.popitem(last=False)
        is_same = (previous.array_info, previous.calibration) == (
            hello.array_info,
            hello.calibration,
        )
        if not is_same or self._has_failed:
            self._begin()

    def feed(self, frames: FrameBatch) -> list[Estimated]:
        """Add the next frames of the present stream; return those whose estimates are due."""
        try:
            return list(self.live.feed(frames))
        except Exception as error:
            self._go_without(error)
            return [(frames, {})]

    def look_for_tare(self, journal: Journal | None, may_come: Callable[[], Intervals]) -> None:
        """Tare if there is reason to, as `TareKeeper.update`.

        Raises:
            StorageError: the tare cannot be stored; it is not in force then, and retried.
        """
        try:
            self.tare_keeper.look(journal, may_come)
        except StorageError:
            raise
        except Exception as error:
            self._go_without(error)

    def _begin(self) -> None:
        self._has_failed = False
        try:
            tare = self.tares.to_use(self.info)
            self.live = LiveEstimates(self.info, self.calibration, tare, self.live)
        except Exception as error:
            self._go_without(error)
            return
        automatic = self._hello.scene.get("auto_tare", True) is not False
        self.tare_keeper = TareKeeper(self.info, self.live, self.tares, automatic=automatic)

    def _go_without(self, error: Exception) -> None:
        node = self.info.node
        log.exception("node %s: this is a bug; it goes on without estimates", node)
        self._has_failed = True
        self.live = LiveEstimates(self.info, None, None, self.live)
        self.live.calibration_problem = f"the estimator failed, until it connects again: {error!r}"
        self.tare_keeper = TareKeeper(self.info, self.live, self.tares, automatic=False)
