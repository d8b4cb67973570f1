"""Estimates of one node's frames as they come, with a tare that may change at any moment."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from devices.compensation import Compensation
from devices.errors import FootTileError, TareError
from devices.frames import ArrayInfo, FrameBatch, FrameStatus
from service.estimation.calibration import Calibration
from service.estimation.flight import LOOK_BACK_NS, tare_in_flight
from service.estimation.models.static import StaticCurves
from service.estimation.plan import make_plan
from service.estimation.tare import Tare, take_tare
from service.pipeline import Columns, EstimateOptions, EstimateRun, EstimateStream

LIVE_LAG_MS = 10.0


class LiveEstimates:
    """One stream's estimates; without calibration or tare, frames pass through without any.

    Args:
        info: the array.
        calibration: of its tiles; None if there is none.
        tare: the one in force, from before.
    """

    def __init__(self, info: ArrayInfo, calibration: Calibration | None, tare: Tare | None) -> None:
        self.calibration_problem: str | None = None
        self._info = info
        self._compensation = Compensation(info.tiles)
        self._calibration: Calibration | None = None
        self.range_kpa: npt.NDArray[np.float64] | None = None
        """End of each tile's calibrated range; None without a calibration."""
        self.full_scale_n: npt.NDArray[np.float64] | None = None
        """Force at that end."""
        self._run: EstimateRun | None = None
        self._recent: deque[FrameBatch] = deque()
        self._lead: list[FrameBatch] = []
        if calibration is not None:
            try:
                EstimateStream(info, EstimateOptions(calibration, info.models, LIVE_LAG_MS))
                self._calibration = calibration
                curves = StaticCurves([calibration.of(serial) for serial in info.serials])
                self.range_kpa = curves.high_kpa
                self.full_scale_n = curves.force(curves.high_kpa[None]).force_n[0]
            except FootTileError as error:  # does not fit these tiles: said, and done without
                self.calibration_problem = str(error)
        self.use(tare)

    @property
    def calibration(self) -> Calibration | None:
        """The calibration in use."""
        return self._calibration

    @property
    def tare(self) -> Tare | None:
        """The tare in use."""
        return self._run.plan.tare if self._run is not None else None

    def use(self, tare: Tare | None) -> None:
        """Estimate with this tare from the next frame on; frames that wait go without estimates."""
        if self._calibration is None or tare is None:
            self._run = None
            return
        plan = make_plan(
            self._info,
            self._calibration,
            tare,
            models=self._info.models,
            lag_ms=LIVE_LAG_MS,
        )
        self._run = EstimateRun(plan)

    def feed(self, frames: FrameBatch) -> Iterator[tuple[FrameBatch, Columns]]:
        """Take the next frames; give those that are due, with or without estimates."""
        self._recent.append(frames)
        while int(frames.t_ns[-1]) - int(self._recent[0].t_ns[-1]) > LOOK_BACK_NS:
            self._recent.popleft()
        if self._run is None:
            yield frames, {}
        else:
            yield from self._run.feed(frames, {})

    def tare_from_lead(self, frames: FrameBatch) -> Tare | None:
        """The tare of an emulated lead, once it is over; None before and after."""
        leading = bool(frames.frame_status[-1] & FrameStatus.LEAD)
        if frames.frame_status[0] & FrameStatus.LEAD and self._calibration is not None:
            self._lead.append(frames)
        if leading or not self._lead or self._calibration is None:
            return None
        taken, self._lead = FrameBatch.concatenate(self._lead), []
        try:
            return take_tare(taken, self._compensation, self._calibration, self._info.serials)
        except TareError:
            return None

    def tare_from_flight(self) -> Tare:
        """The tare from the newest unloaded interval of the last seconds.

        Raises:
            TareError: there was none, no calibration, or no frames.
        """
        if self._calibration is None:
            raise TareError(
                "without a calibration there is nothing to tare",
                remedy="Calibrate the tiles and name the calibration in the node's scene",
            )
        if not self._recent:
            raise TareError("no frames have come yet", remedy="Is the node connected?")
        return tare_in_flight(
            FrameBatch.concatenate(list(self._recent)),
            self._compensation,
            self._calibration,
            self._info.serials,
            present=self.tare,
        )
