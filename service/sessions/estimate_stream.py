"""Estimation of a recording that comes in batches: finds the tare, then estimates.

Used by `run_simulation` during acquisition, by `estimate` from a file, and by the server live and
at sealing. Frames wait until a tare is known; estimates are returned together with their frames.
Warm-up frames, from before the recording, give the models their history, and are not returned.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from functools import partial
from itertools import chain
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from devices.arrays import Columns
from devices.chips.pressure_chips import Compensation
from devices.errors import TareError, UsageError
from devices.flags import FrameFlag
from devices.frames import ArrayInfo, FrameBatch
from service.estimation.calibration import Calibration
from service.estimation.estimate import Estimator, ModelEstimator
from service.estimation.pipeline.plan import (
    EstimationPlan,
    compute_settling_time_s,
    make_plan,
)
from service.estimation.quantization import Quantization
from service.estimation.records import ColumnDict, Estimates
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import RECOGNITION_SPAN_NS, compute_recording_tare
from service.estimation.tare_recovery import remove_recovery
from storage.schema import ROUNDING_STEP_KEY

_ESTIMATED = tuple(f.name for f in fields(Estimates) if f.name not in ("seq", "t_ns"))

ROWS_PER_STEP = 1024
"""Rows per step: more are no faster, and need more memory for a wide array."""


@dataclass(frozen=True)
class EstimateOptions:
    """Options of the estimate of a recording."""

    calibration: Calibration
    models: tuple[str, ...]
    lag_ms: float
    tare_s: tuple[float, float] | None = None
    tares: tuple[Tare, ...] = ()
    """Tares of the time of recording, oldest first; they win over a tare found in the frames."""
    unquantized: bool = False
    """True: nothing is rounded."""
    estimator: type[Estimator] = ModelEstimator


class EstimateRun:
    """Estimates of consecutive frames with one tare, returned together with the frames."""

    def __init__(self, plan: EstimationPlan, estimator: type[Estimator] = ModelEstimator) -> None:
        self.plan = plan
        self._make_estimator = estimator
        self._estimator = estimator(plan)
        self._waiting: deque[tuple[FrameBatch, Columns]] = deque()

    def state_dict(self) -> ColumnDict:
        """Return the state, with the frames that wait for their look-ahead."""
        waiting: ColumnDict = {}
        if self._waiting:
            frames = FrameBatch.concatenate([frames for frames, _ in self._waiting])
            waiting = {f"held/{name}": column for name, column in vars(frames).items()}
            for name in self._waiting[0][1]:
                waiting[f"with/{name}"] = np.concatenate(
                    [extra[name] for _, extra in self._waiting]
                )
        return {f"run/{name}": c for name, c in self._estimator.state_dict().items()} | waiting

    @classmethod
    def from_state(
        cls,
        plan: EstimationPlan,
        state: ColumnDict,
        estimator: type[Estimator] = ModelEstimator,
    ) -> Self:
        """Create a run from the state of another one, as `Estimator.from_state`."""
        new = cls(plan, estimator)
        new._estimator = estimator.from_state(plan, _strip_prefix("run/", state))
        if waiting := _strip_prefix("held/", state):
            new._waiting.append((FrameBatch(**waiting), _strip_prefix("with/", state)))
        return new

    def feed_frames(
        self, frames: FrameBatch, carried_columns: Columns
    ) -> Iterator[tuple[FrameBatch, ColumnDict]]:
        """Add the next frames; yield those whose estimates are due, in order.

        One batch per `ROWS_PER_STEP` frames, since each batch has a fixed cost.
        """
        for begin in range(0, len(frames), ROWS_PER_STEP):
            end = min(begin + ROWS_PER_STEP, len(frames))
            rows, rows_of = frames, carried_columns
            if end - begin < len(frames):  # do not copy a whole live message
                rows = frames.slice_rows(begin, end)
                rows_of = {name: v[begin:end] for name, v in carried_columns.items()}
            self._waiting.append((rows, rows_of))
            yield from _pair_with_frames(self._waiting, self._estimator.process_frames(rows))

    def flush(self) -> Iterator[tuple[FrameBatch, ColumnDict]]:
        """Yield the frames that still wait for their look-ahead: no more frames will come."""
        last = self._estimator.finish()
        self._estimator = self._make_estimator(self.plan)
        if last is not None:
            yield from _pair_with_frames(self._waiting, last)


class EstimateStream:
    """Estimates of one stream; `plan` is known once the tare is.

    Attributes:
        plan: first plan of the estimates.
        rounding: rounding of all estimates; known with `plan`.
        tare: tare of the newest frames.
        settling_time_s: time until its models have settled, with any tare.
    """

    def __init__(self, info: ArrayInfo, options: EstimateOptions) -> None:
        self.plan: EstimationPlan | None = None
        self.rounding = Quantization()
        self.tare: Tare | None = None
        self._info = info
        self._options = options
        self._run: EstimateRun | None = None
        self._tare_changes = 0
        """Number of changes of the tare up to now."""
        self._last_t_mono_ns = 0
        self._warm_up_left = 0
        """Number of warm-up frames that still wait for their look-ahead."""
        # Fail early: unknown models, tiles without calibration.
        if options.tare_s is not None and not 0 <= options.tare_s[0] < options.tare_s[1]:
            raise UsageError(
                f"--tare-s {options.tare_s[0]:g},{options.tare_s[1]:g} is no interval",
                expected="BEGIN,END in seconds from the first frame, BEGIN before END",
            )
        nothing = np.zeros(len(info.tiles))
        plan = self.make_plan(Tare(nothing, nothing, nothing, nothing, 0, 0.0, 0.0, 0, "interval"))
        self.settling_time_s = compute_settling_time_s(plan)

    def estimate_batches(
        self,
        batches: Iterable[tuple[FrameBatch, Columns]],
        *,
        warm_up: Iterable[tuple[FrameBatch, Columns]] = (),
        is_final: bool = True,
    ) -> Iterator[tuple[FrameBatch, ColumnDict]]:
        """Yield frames with their extra columns and estimates, rounded, in order, every frame once.

        Args:
            batches: next frames.
            warm_up: frames just before the first of all, with the same extra columns. They count
                with the first tare, give none, and are not yielded.
            is_final: True: no more frames will come; else `state_dict` has the frames that wait for
                their look-ahead.

        Raises:
            TareError: no tare can be found.
        """
        for frames, found in self._estimate(iter(batches), warm_up, ends=is_final):
            before = min(self._warm_up_left, len(frames))
            self._warm_up_left -= before
            if not before:
                yield frames, self.rounding.round_to_steps(found)
            elif before < len(frames):
                due = {name: values[before:] for name, values in found.items()}
                yield frames.slice_rows(before, len(frames)), self.rounding.round_to_steps(due)

    def state_dict(self) -> ColumnDict:
        """Return the whole state, to resume from.

        Raises:
            TareError: no frame has come yet, so there is no tare.
        """
        if self.plan is None or self._run is None:
            raise TareError("the recording has no frames")
        content = [
            self.plan.tare.as_dict(),
            self._tare_changes,
            self._last_t_mono_ns,
            self._warm_up_left,
        ]
        return {"stream": np.array(json.dumps(content)), **self._run.state_dict()}

    def load_state(self, state: ColumnDict) -> None:
        """Resume from the state of another stream with the same array and options.

        Raises:
            ValueError: the state is of another one.
        """
        content = json.loads(str(state["stream"]))
        tare, self._tare_changes, self._last_t_mono_ns, self._warm_up_left = content
        first = Tare.from_dict(tare, tiles=len(self._info.tiles))
        self._start_run(self._options.tares[0] if self._options.tares else first)
        tares = (first, *self._options.tares[1:])
        self.tare = tares[self._tare_changes]
        self._run = EstimateRun.from_state(
            self.make_plan(self.tare), state, self._options.estimator
        )

    def find_tare_in_first_frames(self, batches: Iterable[tuple[FrameBatch, Columns]]) -> Tare:
        """Find the tare that `estimate_batches` would use; read no more than needed.

        Raises:
            TareError: there is none.
        """
        return self._find_tare([frames for frames, _ in self._read_until_tare(iter(batches))])

    def _estimate(
        self,
        pieces: Iterator[tuple[FrameBatch, Columns]],
        warm_up: Iterable[tuple[FrameBatch, Columns]],
        *,
        ends: bool,
    ) -> Iterator[tuple[FrameBatch, ColumnDict]]:
        run = self._run
        if run is None:
            if self._options.tares:
                run = self._start_run(self._options.tares[0])
            else:
                read_ahead = self._read_until_tare(pieces)
                run = self._start_run(self._find_tare([frames for frames, _ in read_ahead]))
                pieces = chain(read_ahead, pieces)
            pieces = chain(self._count_warm_up(warm_up), pieces)
        for frames, extra in pieces:
            rest, rest_of = frames, extra
            if not len(rest):
                continue
            if int(rest.t_mono_ns[0]) < self._last_t_mono_ns:  # the node was restarted
                yield from run.flush()
            self._last_t_mono_ns = int(rest.t_mono_ns[-1])
            while (tare := self._next_tare()) is not None and int(rest.t_ns[-1]) > tare.t_ns:
                count = int(np.searchsorted(rest.t_ns, tare.t_ns, side="right"))
                if count:
                    head = {name: v[:count] for name, v in rest_of.items()}
                    yield from run.feed_frames(rest.slice_rows(0, count), head)
                    rest = rest.slice_rows(count, len(rest))
                    rest_of = {name: v[count:] for name, v in rest_of.items()}
                yield from run.flush()
                self._run = run = EstimateRun(self.make_plan(tare), self._options.estimator)
                self.tare = tare
                self._tare_changes += 1
            if len(rest):
                yield from run.feed_frames(rest, rest_of)
        if ends:
            yield from run.flush()

    def _count_warm_up(
        self, pieces: Iterable[tuple[FrameBatch, Columns]]
    ) -> Iterator[tuple[FrameBatch, Columns]]:
        for frames, columns in pieces:
            self._warm_up_left += len(frames)
            yield frames, columns

    def _start_run(self, tare: Tare) -> EstimateRun:
        self.plan = self.make_plan(tare)
        if not self._options.unquantized:
            later = map(self.make_plan, self._options.tares[1:])
            self.rounding = Quantization.for_plans(chain([self.plan], later))
        self._run, self.tare = EstimateRun(self.plan, self._options.estimator), tare
        return self._run

    def _next_tare(self) -> Tare | None:
        later = self._options.tares[1 + self._tare_changes :]
        return later[0] if later else None

    def _read_until_tare(
        self, pieces: Iterator[tuple[FrameBatch, Columns]]
    ) -> list[tuple[FrameBatch, Columns]]:
        """Read batches until the tare's interval has passed."""
        batches: list[tuple[FrameBatch, Columns]] = []
        for piece in pieces:
            batches.append(piece)
            if self._has_tare_interval(batches):
                break
        if not batches:
            raise TareError("the recording has no frames")
        return batches

    def _find_tare(self, frames: list[FrameBatch]) -> Tare:
        return compute_recording_tare(
            FrameBatch.concatenate(frames),
            Compensation(self._info.tiles),
            self._options.calibration,
            self._info.serials,
            interval_s=self._options.tare_s,
            remove_recovery=partial(
                remove_recovery,
                info=self._info,
                calibration=self._options.calibration,
                models=self._options.models,
            ),
        )

    def make_plan(self, tare: Tare) -> EstimationPlan:
        """Make the plan of the estimates with this tare."""
        options = self._options
        return make_plan(
            self._info, options.calibration, tare, models=options.models, lag_ms=options.lag_ms
        )

    def _has_tare_interval(self, taken: list[tuple[FrameBatch, Columns]]) -> bool:
        first, newest = taken[0][0], taken[-1][0]
        since_ns = int(newest.t_ns[-1] - first.t_ns[0])
        if self._options.tare_s is not None:
            return since_ns > self._options.tare_s[1] * 1e9
        if first.frame_flags[0] & FrameFlag.LEAD:
            return any(not (frames.frame_flags & FrameFlag.LEAD).all() for frames, _ in taken)
        return since_ns > RECOGNITION_SPAN_NS


def _strip_prefix(prefix: str, state: ColumnDict) -> ColumnDict:
    """Return the columns with a prefix, without it."""
    return {n.removeprefix(prefix): column for n, column in state.items() if n.startswith(prefix)}


def _pair_with_frames(
    waiting: deque[tuple[FrameBatch, Columns]], estimates: Estimates
) -> Iterator[tuple[FrameBatch, ColumnDict]]:
    """Yield the oldest waiting frames with their estimates, as many as there are.

    One batch per run of consecutive numbers: subscribers see a gap between two batches.
    """
    pieces: list[tuple[FrameBatch, Columns]] = []
    first = end = 0
    while end < len(estimates):
        frames, extra = waiting.popleft()
        lack = len(estimates) - end
        if lack < len(frames):
            rest = {name: values[lack:] for name, values in extra.items()}
            waiting.appendleft((frames.slice_rows(lack, len(frames)), rest))
            frames = frames.slice_rows(0, lack)
            extra = {name: values[:lack] for name, values in extra.items()}
        if pieces and int(frames.seq[0]) != int(pieces[-1][0].seq[-1]) + 1:
            yield _join_batches(pieces, estimates.slice_rows(first, end))
            pieces, first = [], end
        pieces.append((frames, extra))
        end += len(frames)
    if pieces:
        yield _join_batches(pieces, estimates.slice_rows(first, end) if first else estimates)


def _join_batches(
    pieces: list[tuple[FrameBatch, Columns]], estimates: Estimates
) -> tuple[FrameBatch, ColumnDict]:
    frames, extra = pieces[0]
    if len(pieces) > 1:
        extra = {name: np.concatenate([extra[name] for _, extra in pieces]) for name in extra}
        frames = FrameBatch.concatenate([frames for frames, _ in pieces])
    return frames, {**extra, **make_estimate_columns(estimates)}


def make_estimate_columns(estimates: Estimates) -> dict[str, npt.NDArray[Any]]:
    """Return the estimates as columns of a sealed file, without `seq` and `t_ns`."""
    return {name: getattr(estimates, name) for name in _ESTIMATED}


def make_estimate_metadata(
    plan: EstimationPlan, rounding: Quantization, tares: tuple[Tare, ...] = ()
) -> dict[str, object]:
    """Return the file metadata of the estimates; enough to compute them again.

    Args:
        plan: plan of the estimates.
        rounding: rounding of the columns.
        tares: all tares of the recording, if they are of its time.
    """
    notes: dict[str, object] = {
        "calibration_id": plan.calibration.id,
        "calibration": plan.calibration.model_dump(mode="json"),
        "absolute_scale": "assumed" if plan.is_scale_assumed else "measured",
        "models": list(plan.models),
        "lag_ms": plan.lag_ns * 1e-6,
        "tare": plan.tare.as_dict(),
        ROUNDING_STEP_KEY: rounding.collect_flat_column_steps(),
    }
    if tares:
        notes["tares"] = [tare.as_dict() for tare in tares]
    return notes
