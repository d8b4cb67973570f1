"""What an estimate costs per frame: `step` and `finish` alone, without reading or writing.

It is the CPU time of the thread that estimates: on an idle machine that is the time it takes, and
on a busy one it does not grow by what others take. Rungs and modes take turns, several times, so
that what is left of a busy moment is there for all of them. A first turn is not counted: models may
be compiled in it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from devices.chips.compensation import Compensation
from devices.frames import FrameBatch
from service.estimation.estimate import EstimationState, finish, step
from service.estimation.plan import EstimationPlan, make_plan
from service.estimation.tare.recorded import take_tare
from service.offline.benchmark.draws import LAGS_MS, Failure, Recording, reason
from service.offline.benchmark.rungs import Rung
from service.sessions.pipeline import CHUNK

BATCH: Mapping[str, int] = {"live": 10, "offline": CHUNK}
"""Frames of one step."""
_WARM_STEPS = 30


class Endless:
    """A recording over and over again, as one stream without a gap."""

    def __init__(self, frames: FrameBatch) -> None:
        self._frames = frames
        self._period_ns = round(float(np.median(np.diff(frames.t_mono_ns))))

    def rows(self, begin: int, end: int) -> FrameBatch:
        """Frames `begin` to `end` of the stream; `seq` and time rise throughout."""
        n = len(self._frames)
        lap, at = np.divmod(np.arange(begin, end), n)
        once = self._frames.select(at)
        span_ns = int(self._frames.t_mono_ns[-1] - self._frames.t_mono_ns[0]) + self._period_ns
        return replace(
            once,
            seq=np.arange(begin, end, dtype=np.uint64) + self._frames.seq[0],
            t_mono_ns=once.t_mono_ns + lap * span_ns,
            t_ns=once.t_ns + lap * span_ns,
        )


def time_rungs(
    recording: Recording,
    rungs: Sequence[Rung],
    frames: Mapping[str, int],
    repetitions: int,
) -> tuple[dict[tuple[str, str], list[float]], list[Failure]]:
    """Nanoseconds per frame of every repetition, by mode and label of the rung.

    Args:
        recording: whose frames are estimated over and over again.
        rungs: what to time.
        frames: how many frames make one repetition, by mode.
        repetitions: how many.

    Returns:
        The times, and the rungs that could not be timed.
    """
    stream = Endless(recording.frames)
    plans: dict[tuple[str, str], EstimationPlan] = {}
    failures = []
    for rung in rungs:
        for mode in LAGS_MS:
            try:
                plan = plan_of(recording, rung.models, LAGS_MS[mode])
                ns_per_frame(plan, stream, _WARM_STEPS * BATCH[mode], BATCH[mode])
            except Exception as error:
                failures.append(Failure(f"time of {rung.label}, {mode}", reason(error)))
            else:
                plans[mode, rung.label] = plan
    times: dict[tuple[str, str], list[float]] = {key: [] for key in plans}
    for _ in range(repetitions):
        for (mode, label), plan in plans.items():
            spent_ns = ns_per_frame(plan, stream, frames[mode], BATCH[mode])
            times[mode, label].append(spent_ns)
    return times, failures


def plan_of(recording: Recording, models: tuple[str, ...], lag_ms: float) -> EstimationPlan:
    """The constants of an estimate of a recording, tared from its lead.

    Raises:
        FootTileError: no estimate with these models.
    """
    info, calibration = recording.info, recording.calibration
    tare = take_tare(recording.frames, Compensation(info.tiles), calibration, info.serials)
    return make_plan(info, calibration, tare, models=models, lag_ms=lag_ms)


def ns_per_frame(plan: EstimationPlan, stream: Endless, frames: int, batch: int) -> float:
    """CPU time of estimating the first `frames` frames of a stream, `batch` of them a step."""
    state = EstimationState()
    spent_ns = 0
    for begin in range(0, frames, batch):
        rows = stream.rows(begin, min(begin + batch, frames))
        began_ns = time.thread_time_ns()
        _, state = step(plan, rows, state)
        spent_ns += time.thread_time_ns() - began_ns
    began_ns = time.thread_time_ns()
    finish(plan, state)
    return (spent_ns + time.thread_time_ns() - began_ns) / frames
