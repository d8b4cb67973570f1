"""Live estimates of one stream, with a tare that may change at any frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from typing import Self

import numpy as np

from devices.arrays import Floats
from devices.chips.pressure_chips import Compensation
from devices.errors import FootTileError, TareError
from devices.flags import TileFlag
from devices.frames import NOT_READ, ArrayInfo, FrameBatch, hold_temperature
from service.estimation import LIVE_LAG_MS, LONG_GAP_NS
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.compilation import is_compiling
from service.estimation.models.static import StaticParams, compute_forces
from service.estimation.pipeline.plan import SETTLING_MIN_S, EstimationPlan, make_plan
from service.estimation.records import ColumnDict
from service.estimation.tare.automatic import (
    HISTORY_NS,
    FlightTareResult,
    compute_newest_unloaded_tare,
    propose_first_tare_between_steps,
    propose_flight_tare,
)
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import TareFrames, compute_recording_tare
from service.estimation.tare_recovery import remove_recovery
from service.sessions.estimate_stream import EstimateOptions, EstimateRun, EstimateStream


@dataclass(frozen=True)
class TileRanges:
    """Ranges of an array's tiles; arrays are (tiles,), NaN for tiles that bear no load.

    Attributes:
        entries: calibration of each tile; None for bare ones.
        end_kpa: end of each tile's calibrated range.
        full_scale_n: force at that end.
        slope_n_per_kpa: slope near zero.
        is_scale_assumed: True if the newtons of any tile rest on an assumption.
    """

    entries: tuple[TileCalibration | None, ...]
    end_kpa: Floats
    full_scale_n: Floats
    slope_n_per_kpa: Floats
    is_scale_assumed: bool

    @classmethod
    def from_calibration(cls, info: ArrayInfo, calibration: Calibration) -> Self:
        """Compute ends of ranges from curves and mount gains; NaN for reference tiles.

        Raises:
            CalibrationError: a tile that bears load is not in it.
        """
        serials = info.serials
        bearing = [i for i, tile in enumerate(info.tiles) if not tile.reference]
        curves = StaticParams.from_calibrations(
            calibration.get_tiles_or_wildcard([serials[i] for i in bearing])
        )
        high_kpa = curves["range_high_kpa"]
        gains = [calibration.find_mount_gain(serials[i]) for i in bearing]
        gain = np.array([1.0 if one is None else one.value for one in gains])

        def by_tile(values: Floats) -> Floats:
            of_all = np.full(len(info.tiles), np.nan)
            of_all[bearing] = values
            return of_all

        return cls(
            entries=tuple(calibration.find_tile_or_wildcard(serial) for serial in serials),
            end_kpa=by_tile(high_kpa),
            full_scale_n=by_tile(gain * compute_forces(curves, high_kpa[None]).force_n[0]),
            slope_n_per_kpa=by_tile(gain * curves["slope_at_zero_n_per_kpa"]),
            is_scale_assumed=calibration.has_assumed_scale([serials[i] for i in bearing]),
        )


_TADC_OVER_NS = 1_000_000_000
_EPOCHS_MAX = 256
_STATES_MAX = 20  # ten minutes, as the journal has of frames that no session needs
STATE_PERIOD_NS = 30_000_000_000
_GAP_PERIOD_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class EstimateEpoch:
    """Frames that are estimated with one calibration and tare, from one state of the models on.

    Attributes:
        calibration: calibration in use; None: they are not estimated.
        tare: tare in force; None: they are not estimated.
        seq: first frame.
        t_ns: time after which it is in force instead, node's UTC; None: `seq` holds.
        state: state of the run before the first frame; None: the initial one.
        seen_seq: newest frame that this state has seen; None: none.
    """

    calibration: Calibration | None
    tare: Tare | None
    seq: int = 0
    t_ns: int | None = None
    state: ColumnDict | None = None
    seen_seq: int | None = None

    def count_rows_before(self, frames: FrameBatch) -> int:
        """Return the number of frames before it."""
        if self.t_ns is not None:
            return int(np.searchsorted(frames.t_ns, self.t_ns, side="right"))
        return int(np.searchsorted(frames.seq, self.seq, side="left"))

    def make_run(self, info: ArrayInfo) -> EstimateRun | None:
        """Make the run that estimates its frames; None: they are not estimated."""
        if self.calibration is None or self.tare is None:
            return None
        plan = make_live_plan(info, self.calibration, self.tare)
        return EstimateRun(plan) if self.state is None else EstimateRun.from_state(plan, self.state)


class EpochHistory:
    """Epochs of one stream since the server was started, with states to go on from.

    A state is stored every 30 s, and where live goes on behind frames that it has not seen, at most
    once a second. The oldest go first, each kind by itself: a bad link leaves the regular ones.
    """

    def __init__(self) -> None:
        self._from_initial_state: deque[EstimateEpoch] = deque(maxlen=_EPOCHS_MAX)
        self._regular: deque[EstimateEpoch] = deque(maxlen=_STATES_MAX)
        self._behind_gaps: deque[EstimateEpoch] = deque(maxlen=_STATES_MAX)
        self._next_regular_ns = self._next_gap_ns = 0

    def list_epochs(self) -> list[EstimateEpoch]:
        """Return the epochs, oldest first."""
        epochs = (*self._from_initial_state, *self._regular, *self._behind_gaps)
        return sorted(epochs, key=lambda epoch: epoch.seq)

    def drop_states(self) -> None:
        """Keep only calibrations and tares: states take memory, some 20 kB a tile each."""
        self._regular.clear()
        self._behind_gaps.clear()

    def begin_epoch(
        self, frames: FrameBatch, calibration: Calibration | None, tare: Tare | None
    ) -> None:
        """Record that these frames are the first with this calibration and tare."""
        self._from_initial_state.append(EstimateEpoch(calibration, tare, int(frames.seq[0])))
        self._next_gap_ns = int(frames.t_mono_ns[0])
        self._next_regular_ns = self._next_gap_ns + STATE_PERIOD_NS

    def store_state_if_due(
        self, frames: FrameBatch, seen_seq: int, calibration: Calibration, run: EstimateRun
    ) -> None:
        """Store the state of a run before its next frames.

        Args:
            frames: the next frames.
            seen_seq: newest frame before them.
            calibration: calibration of the run.
            run: the run.
        """
        t_mono_ns, seq = int(frames.t_mono_ns[0]), int(frames.seq[0])
        follows_gap = seq != seen_seq + 1
        if t_mono_ns < (self._next_gap_ns if follows_gap else self._next_regular_ns):
            return
        state = run.state_dict()
        epoch = EstimateEpoch(calibration, run.plan.tare, seq, state=state, seen_seq=seen_seq)
        if follows_gap:
            self._behind_gaps.append(epoch)
            self._next_gap_ns = t_mono_ns + _GAP_PERIOD_NS
        else:
            self._regular.append(epoch)
            self._next_regular_ns = t_mono_ns + STATE_PERIOD_NS


def make_live_plan(info: ArrayInfo, calibration: Calibration, tare: Tare) -> EstimationPlan:
    """Make the plan of live estimates of a stream."""
    return make_plan(info, calibration, tare, models=info.models, lag_ms=LIVE_LAG_MS)


class LiveEstimator:
    """Estimator of one stream; without calibration or tare, frames pass through.

    Args:
        info: the array.
        calibration: calibration of its tiles; None if there is none.
        tare: tare in force.
        previous: former estimator of this node; if it was of the same stream, its epochs go on.
    """

    def __init__(
        self,
        info: ArrayInfo,
        calibration: Calibration | None,
        tare: Tare | None,
        previous: LiveEstimator | None = None,
    ) -> None:
        self.calibration_problem: str | None = None
        self.info = info
        self._compensation = Compensation(info.tiles)
        self._is_loaded_tile = np.array([not tile.reference for tile in info.tiles])
        self.calibration: Calibration | None = None
        """Calibration in use."""
        self.calibration_id: str | None = None
        """Id of the calibration in use: a hash that is slow to compute."""
        self.ranges: TileRanges | None = None
        """Calibrated ranges of the tiles; None without a calibration."""
        self.settling_time_s = SETTLING_MIN_S
        """Time until the models have settled; the shortest one without a calibration."""
        self.airborne_since_t_ns: int | None = None
        """Time since which all estimates are without contact; None: not yet."""
        self.unloaded_seq: int | None = None
        """Number of the newest frame without contact; None: not yet."""
        self._run: EstimateRun | None = None
        self._recent: deque[FrameBatch] = deque()
        self._flushed: list[tuple[FrameBatch, ColumnDict]] = []
        self._estimated_t_ns: int | None = None
        self._has_epoch = False
        self.epochs = EpochHistory()
        """Epochs of the estimates, to recompute frames as they were."""
        if previous is not None and previous.info.stream_id == info.stream_id:
            self.epochs, self.unloaded_seq = previous.epochs, previous.unloaded_seq
        if calibration is not None:
            try:
                options = EstimateOptions(calibration, info.models, LIVE_LAG_MS)
                self.settling_time_s = EstimateStream(info, options).settling_time_s
                self.calibration = calibration
                self.calibration_id = calibration.id
                self.ranges = TileRanges.from_calibration(info, calibration)
            except FootTileError as error:  # it does not fit these tiles: report it
                self.calibration_problem = str(error)
        self.set_tare(tare)

    @property
    def tare_in_use_unless_lost(self) -> Tare | None:
        """Tare in use; None: there is none, or it is lost."""
        tare = self._run.plan.tare if self._run is not None else None
        return None if tare is None or tare.is_lost else tare

    def set_tare(self, tare: Tare | None) -> None:
        """Estimate with this tare from the next frame on; all is NaN with a lost one."""
        if self._run is not None:  # frames that wait for their look-ahead
            self._flushed.extend(self._run.flush())
        self.airborne_since_t_ns = None
        self._has_epoch = False
        if self.calibration is None or tare is None:
            self._run = None
            return
        self._run = EstimateRun(make_live_plan(self.info, self.calibration, tare))

    def drain_frames_from(self, previous: LiveEstimator) -> None:
        """Take the frames of an estimator of the same stream with another calibration, and end it.

        Its recent frames are taken over, not copied; frames that wait for their look-ahead are
        flushed first.
        """
        previous.set_tare(None)
        self._recent, self._flushed = previous._recent, previous._flushed

    def estimate_or_pass_frames(
        self, frames: FrameBatch
    ) -> Iterator[tuple[FrameBatch, ColumnDict]]:
        """Add the next frames; yield the frames that are due, with or without estimates."""
        seen_seq = int(self._recent[-1].seq[-1]) if self._recent else -1
        self._recent.append(frames)
        while int(frames.t_ns[-1]) - int(self._recent[0].t_ns[-1]) > HISTORY_NS:
            self._recent.popleft()
        flushed, self._flushed = self._flushed, []
        yield from flushed
        if self._run is None:
            if not self._has_epoch:
                self._has_epoch = True
                self.epochs.begin_epoch(frames, self.calibration, None)
            yield frames, {}
            return
        if is_compiling():
            with_temperature, _ = hold_temperature(frames)
            kpa = (
                self._compensation.compute_usable_kpa(with_temperature)
                - self._run.plan.tare.baseline_kpa
            )
            yield frames, {"gauge_kpa": kpa}
            return
        assert self.calibration is not None  # noqa: S101  # or there was no run
        if self._has_epoch:
            self.epochs.store_state_if_due(frames, seen_seq, self.calibration, self._run)
        else:
            self._has_epoch = True
            self.epochs.begin_epoch(frames, self.calibration, self._run.plan.tare)
        for due, columns in self._run.feed_frames(frames, {}):
            self._update_contact(due, columns)
            yield due, columns

    @property
    def newest_batch(self) -> FrameBatch | None:
        """Last batch of frames; None before the first."""
        return self._recent[-1] if self._recent else None

    @property
    def newest_t_ns(self) -> int | None:
        """Time of the newest frame, node's UTC."""
        return int(self._recent[-1].t_ns[-1]) if self._recent else None

    @property
    def counts_per_kelvin(self) -> Floats:
        """Temperature counts per kelvin of each tile's chip."""
        return self._compensation.counts_per_kelvin

    def mean_recent_temperature_raw(self) -> Floats:
        """Return the mean temperature counts of the last second, per tile; NaN if none was read."""
        if not self._recent:
            return np.full(len(self.info.tiles), np.nan)
        since_t_ns = int(self._recent[-1].t_ns[-1]) - _TADC_OVER_NS
        recent = [*takewhile(lambda each: each.t_ns[-1] >= since_t_ns, reversed(self._recent))]
        temperature_raw = np.concatenate([frames.temperature_raw for frames in recent])
        status = np.concatenate([frames.tile_flags for frames in recent])
        is_usable = (temperature_raw != NOT_READ) & ((status & np.uint8(TileFlag.UNUSABLE)) == 0)
        counts = is_usable.sum(axis=0)
        total = np.where(is_usable, temperature_raw, 0).sum(axis=0)
        return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)

    def grf_shift_n(self, baseline_shift_kpa: Floats) -> float | None:
        """Return the GRF shift that follows from a shift of all baselines; None if unknown."""
        if self.ranges is None:
            return None
        slope_n_per_kpa = self.ranges.slope_n_per_kpa
        shift_n = (slope_n_per_kpa * baseline_shift_kpa)[np.isfinite(slope_n_per_kpa)]
        return float(shift_n.sum()) if np.isfinite(shift_n).all() else None

    def compute_lead_tare(self, lead: FrameBatch) -> Tare:
        """Compute the tare from an emulated lead; the tare in force is unchanged.

        Raises:
            TareError: its frames give no tare, or there is no calibration.
        """
        return compute_recording_tare(
            lead, self._compensation, self._require_calibration(), self.info.serials
        )

    def find_ongoing_flight_or_first_tare(self, anchor: Tare | None) -> FlightTareResult:
        """Look for an automatic tare in the last seconds.

        Args:
            anchor: tare with which an automatic one is compared; None without a tare.
        """
        calibration, tare = self.calibration, self.tare_in_use_unless_lost
        if calibration is None or not self._recent or is_compiling():
            return FlightTareResult()
        frames = FrameBatch.concatenate(list(self._recent))
        if tare is None:
            return propose_first_tare_between_steps(self._tare_frames(frames, calibration))
        if self.airborne_since_t_ns is None or self._estimated_t_ns is None:
            return FlightTareResult()
        # Contact of newer frames is not estimated yet.
        count = int(np.searchsorted(frames.t_ns, self._estimated_t_ns, side="right"))
        return propose_flight_tare(
            self._tare_frames(frames.slice_rows(0, count), calibration),
            present=tare,
            last_manual=anchor,
            no_contact_since_t_ns=self.airborne_since_t_ns,
            is_load_bearing=self._is_loaded_tile,
        )

    def compute_unloaded_tare(self) -> Tare:
        """Compute a tare from the newest unloaded interval of the last seconds, not in force yet.

        Raises:
            TareError: there is no such interval, no calibration, or no frame.
        """
        calibration = self._require_calibration()
        if not self._recent:
            raise TareError("no frames have come yet", remedy="Connect the node")
        frames = FrameBatch.concatenate(list(self._recent))
        seen = self._tare_frames(frames, calibration)
        tare = compute_newest_unloaded_tare(
            seen, present=self.tare_in_use_unless_lost, is_load_bearing=self._is_loaded_tile
        )
        return seen.remove_recovery(tare)

    def _tare_frames(self, frames: FrameBatch, calibration: Calibration) -> TareFrames:
        info = self.info
        # While the models are being compiled, an estimate would wait, and the event loop with it.
        removal = (
            None
            if is_compiling()
            else partial(remove_recovery, info=info, calibration=calibration, models=info.models)
        )
        return TareFrames(frames, self._compensation, calibration, info.serials, removal)

    def _require_calibration(self) -> Calibration:
        if self.calibration is None:
            raise TareError(
                "without a calibration there is nothing to tare",
                remedy="Calibrate the tiles and name the calibration in the node's scene",
            )
        return self.calibration

    def _update_contact(self, frames: FrameBatch, columns: ColumnDict) -> None:
        t_ns = frames.t_ns
        if len(unloaded := np.flatnonzero(columns["contact"] == 0)):
            self.unloaded_seq = int(frames.seq[unloaded[-1]])
        before_t_ns = self._estimated_t_ns if self._estimated_t_ns is not None else int(t_ns[0])
        may_have_contact = columns["contact"] != 0  # in contact, or unknown
        # A gap that is too short for a step, such as a missed slot, cannot hide a contact.
        if int(t_ns[-1]) - before_t_ns > LONG_GAP_NS:
            may_have_contact[0] |= int(t_ns[0]) - before_t_ns > LONG_GAP_NS
            may_have_contact[1:] |= t_ns[1:] - t_ns[:-1] > LONG_GAP_NS
        self._estimated_t_ns = int(t_ns[-1])
        if np.count_nonzero(may_have_contact):
            self.airborne_since_t_ns = int(t_ns[np.flatnonzero(may_have_contact)[-1]])
        elif self.airborne_since_t_ns is None:
            self.airborne_since_t_ns = int(t_ns[0])
