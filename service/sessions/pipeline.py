"""Estimation of a recording that comes in batches: finds the tare, then estimates.

Used by `simulate` during acquisition, by `estimate` from a file, and by the server live and at
sealing. Frames wait until a tare is known; estimates are returned together with their frames.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from itertools import chain
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from devices.chips.compensation import Compensation
from devices.errors import TareError, UsageError
from devices.frames import ArrayInfo, FrameBatch, FrameStatus
from service.estimation.calibration import Calibration
from service.estimation.estimate import Estimator
from service.estimation.estimates import Estimates
from service.estimation.ladder.plan import EstimationPlan, make_plan
from service.estimation.rounding import Rounding
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded import RECOGNISE_WITHIN_NS, take_tare
from storage.schema import ROUNDED_TO

Extra = Mapping[str, npt.NDArray[Any]]
Columns = dict[str, npt.NDArray[Any]]
_ESTIMATED = tuple(f.name for f in fields(Estimates) if f.name not in ("seq", "t_ns"))

CHUNK = 1024
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
    exact: bool = False
    """True: nothing is rounded."""


class EstimateRun:
    """Estimates of consecutive frames with one tare, returned together with the frames."""

    def __init__(self, plan: EstimationPlan) -> None:
        self.plan = plan
        self._estimator = Estimator(plan)
        self._held: deque[tuple[FrameBatch, Extra]] = deque()

    def kept(self) -> Columns:
        """Return the state, with the frames that wait for their look-ahead."""
        waiting: Columns = {}
        if self._held:
            frames = FrameBatch.concatenate([frames for frames, _ in self._held])
            waiting = {f"held/{name}": column for name, column in vars(frames).items()}
            for name in self._held[0][1]:
                waiting[f"with/{name}"] = np.concatenate([extra[name] for _, extra in self._held])
        return {f"run/{name}": c for name, c in self._estimator.kept().items()} | waiting

    @classmethod
    def going_on(cls, plan: EstimationPlan, kept: Columns) -> Self:
        """Create a run from the state of another one, as `Estimator.going_on`."""
        new = cls(plan)
        new._estimator = Estimator.going_on(plan, _under("run/", kept))
        if waiting := _under("held/", kept):
            new._held.append((FrameBatch(**waiting), _under("with/", kept)))
        return new

    def feed(self, frames: FrameBatch, extra: Extra) -> Iterator[tuple[FrameBatch, Columns]]:
        """Add the next frames; yield those whose estimates are due, in order.

        One batch per `CHUNK` frames, since each batch has a fixed cost.
        """
        for begin in range(0, len(frames), CHUNK):
            end = min(begin + CHUNK, len(frames))
            rows, rows_of = frames, extra
            if end - begin < len(frames):  # do not copy a whole live message
                rows = frames.rows(begin, end)
                rows_of = {name: v[begin:end] for name, v in extra.items()}
            self._held.append((rows, rows_of))
            yield from _paired(self._held, self._estimator.step(rows))

    def finish(self) -> Iterator[tuple[FrameBatch, Columns]]:
        """Yield the frames that still wait for their look-ahead: no more frames will come."""
        last = self._estimator.finish()
        self._estimator = Estimator(self.plan)
        if last is not None:
            yield from _paired(self._held, last)


class EstimateStream:
    """Estimates of one stream; `plan` is known once the tare is.

    Attributes:
        plan: first plan of the estimates.
        rounding: rounding of all estimates; known with `plan`.
        tare: tare of the newest frames.
    """

    def __init__(self, info: ArrayInfo, options: EstimateOptions) -> None:
        self.plan: EstimationPlan | None = None
        self.rounding = Rounding()
        self.tare: Tare | None = None
        self._info = info
        self._options = options
        self._run: EstimateRun | None = None
        self._over = 0
        """Number of changes of the tare up to now."""
        self._last_t_mono_ns = 0
        # Fail early: unknown models, tiles without calibration.
        if options.tare_s is not None and not 0 <= options.tare_s[0] < options.tare_s[1]:
            raise UsageError(
                f"--tare-s {options.tare_s[0]:g},{options.tare_s[1]:g} is no interval",
                expected="BEGIN,END in seconds from the first frame, BEGIN before END",
            )
        nothing = np.zeros(len(info.tiles))
        self.plan_of(Tare(nothing, nothing, nothing, nothing, 0, 0.0, 0.0, 0, "interval"))

    def run(
        self, pieces: Iterable[tuple[FrameBatch, Extra]], *, ends: bool = True
    ) -> Iterator[tuple[FrameBatch, Columns]]:
        """Yield frames with their extra columns and estimates, rounded, in order, every frame once.

        Args:
            pieces: next frames.
            ends: True: no more frames will come; else `kept` has the frames that wait for
                their look-ahead.

        Raises:
            TareError: no tare can be found.
        """
        for frames, columns in self._estimated(iter(pieces), ends=ends):
            yield frames, self.rounding.rounded(columns)

    def kept(self) -> Columns:
        """Return the whole state, to resume from.

        Raises:
            TareError: no frame has come yet, so there is no tare.
        """
        if self.plan is None or self._run is None:
            raise TareError("the recording has no frames")
        content = [self.plan.tare.as_dict(), self._over, self._last_t_mono_ns]
        return {"stream": np.array(json.dumps(content)), **self._run.kept()}

    def go_on(self, kept: Columns) -> None:
        """Resume from the state of another stream with the same array and options.

        Raises:
            ValueError: the state is of another one.
        """
        tare, self._over, self._last_t_mono_ns = json.loads(str(kept["stream"]))
        first = Tare.from_dict(tare, tiles=len(self._info.tiles))
        self._begin(self._options.tares[0] if self._options.tares else first)
        tares = (first, *self._options.tares[1:])
        self.tare = tares[self._over]
        self._run = EstimateRun.going_on(self.plan_of(self.tare), kept)

    def find_tare(self, pieces: Iterable[tuple[FrameBatch, Extra]]) -> Tare:
        """Find the tare that `run` would use; read no more than needed.

        Raises:
            TareError: there is none.
        """
        return self._find_tare([frames for frames, _ in self._until_tare(iter(pieces))])

    def _estimated(
        self, pieces: Iterator[tuple[FrameBatch, Extra]], *, ends: bool
    ) -> Iterator[tuple[FrameBatch, Columns]]:
        run = self._run
        if run is None:
            if self._options.tares:
                run = self._begin(self._options.tares[0])
            else:
                read_ahead = self._until_tare(pieces)
                run = self._begin(self._find_tare([frames for frames, _ in read_ahead]))
                pieces = chain(read_ahead, pieces)
        for frames, extra in pieces:
            rest, rest_of = frames, extra
            if not len(rest):
                continue
            if int(rest.t_mono_ns[0]) < self._last_t_mono_ns:  # the node was restarted
                yield from run.finish()
            self._last_t_mono_ns = int(rest.t_mono_ns[-1])
            while (tare := self._next_tare()) is not None and int(rest.t_ns[-1]) > tare.t_ns:
                count = int(np.searchsorted(rest.t_ns, tare.t_ns, side="right"))
                if count:
                    head = {name: v[:count] for name, v in rest_of.items()}
                    yield from run.feed(rest.rows(0, count), head)
                    rest = rest.rows(count, len(rest))
                    rest_of = {name: v[count:] for name, v in rest_of.items()}
                yield from run.finish()
                self._run = run = EstimateRun(self.plan_of(tare))
                self.tare = tare
                self._over += 1
            if len(rest):
                yield from run.feed(rest, rest_of)
        if ends:
            yield from run.finish()

    def _begin(self, tare: Tare) -> EstimateRun:
        self.plan = self.plan_of(tare)
        if not self._options.exact:
            later = map(self.plan_of, self._options.tares[1:])
            self.rounding = Rounding.of(chain([self.plan], later))
        self._run, self.tare = EstimateRun(self.plan), tare
        return self._run

    def _next_tare(self) -> Tare | None:
        later = self._options.tares[1 + self._over :]
        return later[0] if later else None

    def _until_tare(
        self, pieces: Iterator[tuple[FrameBatch, Extra]]
    ) -> list[tuple[FrameBatch, Extra]]:
        """Read batches until the tare's interval has passed."""
        batches: list[tuple[FrameBatch, Extra]] = []
        for piece in pieces:
            batches.append(piece)
            if self._tare_is_in(batches):
                break
        if not batches:
            raise TareError("the recording has no frames")
        return batches

    def _find_tare(self, frames: list[FrameBatch]) -> Tare:
        return take_tare(
            FrameBatch.concatenate(frames),
            Compensation(self._info.tiles),
            self._options.calibration,
            self._info.serials,
            interval_s=self._options.tare_s,
        )

    def plan_of(self, tare: Tare) -> EstimationPlan:
        """Make the plan of the estimates with this tare."""
        options = self._options
        return make_plan(
            self._info, options.calibration, tare, models=options.models, lag_ms=options.lag_ms
        )

    def _tare_is_in(self, taken: list[tuple[FrameBatch, Extra]]) -> bool:
        first, newest = taken[0][0], taken[-1][0]
        since_ns = int(newest.t_ns[-1] - first.t_ns[0])
        if self._options.tare_s is not None:
            return since_ns > self._options.tare_s[1] * 1e9
        if first.frame_status[0] & FrameStatus.LEAD:
            return any(not (frames.frame_status & FrameStatus.LEAD).all() for frames, _ in taken)
        return since_ns > RECOGNISE_WITHIN_NS


def _under(prefix: str, kept: Columns) -> Columns:
    """Return the columns with a prefix, without it."""
    return {n.removeprefix(prefix): column for n, column in kept.items() if n.startswith(prefix)}


def _paired(
    held: deque[tuple[FrameBatch, Extra]], estimates: Estimates
) -> Iterator[tuple[FrameBatch, Columns]]:
    """Yield the oldest waiting frames with their estimates, as many as there are.

    One batch per run of consecutive numbers: subscribers see a gap between two batches.
    """
    pieces: list[tuple[FrameBatch, Extra]] = []
    first = end = 0
    while end < len(estimates):
        frames, extra = held.popleft()
        lack = len(estimates) - end
        if lack < len(frames):
            rest = {name: values[lack:] for name, values in extra.items()}
            held.appendleft((frames.rows(lack, len(frames)), rest))
            frames = frames.rows(0, lack)
            extra = {name: values[:lack] for name, values in extra.items()}
        if pieces and int(frames.seq[0]) != int(pieces[-1][0].seq[-1]) + 1:
            yield _joined(pieces, estimates.rows(first, end))
            pieces, first = [], end
        pieces.append((frames, extra))
        end += len(frames)
    if pieces:
        yield _joined(pieces, estimates.rows(first, end) if first else estimates)


def _joined(
    pieces: list[tuple[FrameBatch, Extra]], estimates: Estimates
) -> tuple[FrameBatch, Columns]:
    frames, extra = pieces[0]
    if len(pieces) > 1:
        extra = {name: np.concatenate([extra[name] for _, extra in pieces]) for name in extra}
        frames = FrameBatch.concatenate([frames for frames, _ in pieces])
    return frames, {**extra, **estimate_columns(estimates)}


def estimate_columns(estimates: Estimates) -> dict[str, npt.NDArray[Any]]:
    """Return the estimates as columns of a sealed file, without `seq` and `t_ns`."""
    return {name: getattr(estimates, name) for name in _ESTIMATED}


def notes_of(
    plan: EstimationPlan, rounding: Rounding, tares: tuple[Tare, ...] = ()
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
        "absolute_scale": "assumed" if plan.assumed_scale else "measured",
        "models": list(plan.models),
        "lag_ms": plan.lag_ns * 1e-6,
        "tare": plan.tare.as_dict(),
        ROUNDED_TO: rounding.by_column(),
    }
    if tares:
        notes["tares"] = [tare.as_dict() for tare in tares]
    return notes
