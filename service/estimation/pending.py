"""Frames whose look-ahead is not complete, and those before them that averages reach back to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Arrays, Ints, Times
from service.estimation.foot.kinematics import Readings
from service.estimation.lower import ApparentForces
from service.estimation.models import denoise


@dataclass(frozen=True)
class PendingFrames(Arrays):
    """Facts of frames that are needed once, when their estimate is due; arrays (n,).

    Attributes:
        seq: number in the stream.
        t_ns: UTC.
        loaded: does the foot seem loaded, from `contact.seeming`?
        since_ns: since when it has seemed so.
    """

    seq: npt.NDArray[np.uint64]
    t_ns: Times
    loaded: Ints
    since_ns: Times


@dataclass(frozen=True)
class Pending:
    """What is known of frames without an estimate so far.

    Attributes:
        forces: of these frames, after those that are only there to be reached back to.
        frames: these frames.
        readings: of the servo in these frames; None without one.
    """

    forces: ApparentForces
    frames: PendingFrames
    readings: Readings | None

    @property
    def first(self) -> int:
        """Row of `forces` at which `frames` begins."""
        return len(self.forces.run) - len(self.frames.seq)

    def followed_by(self, later: Pending) -> Pending:
        """These frames and then later ones."""
        readings = later.readings
        if readings is not None and self.readings is not None:
            readings = Readings.concatenate([self.readings, readings])
        return Pending(
            ApparentForces.concatenate([self.forces, later.forces]),
            PendingFrames.concatenate([self.frames, later.frames]),
            readings,
        )

    def after(self, given: int, *, reach_back: bool) -> Pending:
        """Without the first `given` frames, but for what averages will reach back to."""
        n, end = len(self.frames.seq), len(self.forces.run)
        keep = first = self.first + given
        if reach_back:
            t_mono_ns = self.forces.t_mono_ns
            # The next one may not be here yet; it will be no earlier than the last that is.
            oldest_ns = t_mono_ns[min(first, end - 1)] - denoise.PAST_NS
            keep = max(int(np.searchsorted(t_mono_ns, oldest_ns)), first - int(denoise.REACHES[-1]))
        return Pending(
            self.forces.rows(keep, end),
            self.frames.rows(given, n),
            None if self.readings is None else self.readings.rows(given, n),
        )
