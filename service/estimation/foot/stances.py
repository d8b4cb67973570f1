"""Stances: from the first loaded frame of a contact to the last, with peak and impulse.

A step begins with each of them. They follow from the columns `t_ns`, `grf_n` and `contact`, and it
does not matter in which batches these come.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Ints, Times
from service.estimation.foot.contact import UNKNOWN


@dataclass(frozen=True)
class Stance:
    """One contact of the foot with the ground.

    Attributes:
        begin_t_ns: UTC of its first frame.
        end_t_ns: UTC of its last.
        peak_n: greatest GRF; NaN if none is known.
        peak_t_ns: when that was.
        impulse_ns: integral of the GRF by the trapezoidal rule, in newton seconds; straight across
            frames without one.
        unknown_frames: how many those are.
        begun: it began within the recording.
        ended: it ended within the recording.
    """

    begin_t_ns: int
    end_t_ns: int
    peak_n: float
    peak_t_ns: int
    impulse_ns: float
    unknown_frames: int
    begun: bool
    ended: bool

    @property
    def duration_s(self) -> float:
        """From the first frame to the last."""
        return (self.end_t_ns - self.begin_t_ns) * 1e-9


class Stances:
    """Gathers stances from consecutive estimates; keeps the frames of the present one only."""

    def __init__(self) -> None:
        self._over: list[Stance] = []
        self._pieces: list[tuple[Ints, Floats]] = []
        self._contact = 0
        self._begun = False
        self._seen = False

    def feed(self, t_ns: Times, grf_n: Floats, contact: npt.NDArray[np.uint8]) -> None:
        """Take n more frames.

        Args:
            t_ns: (n,), UTC.
            grf_n: (n,), NaN where it is not known.
            contact: (n,), 1, 0, or `UNKNOWN`, which changes nothing.
        """
        known = contact != UNKNOWN
        last = np.maximum.accumulate(np.where(known, np.arange(len(contact)), -1))
        loaded = np.where(last >= 0, contact[last], self._contact)
        edges = np.flatnonzero(np.diff(loaded, prepend=np.uint8(self._contact)))
        for begin, end in zip([0, *edges], [*edges, len(loaded)], strict=True):
            if begin == end:
                continue
            if loaded[begin]:
                if not self._pieces:
                    self._begun = self._seen or bool(known[:begin].any())
                self._pieces.append((t_ns[begin:end], grf_n[begin:end]))
            else:
                self._close(ended=True)
        if len(loaded):
            self._contact = int(loaded[-1])
            self._seen = self._seen or bool(known.any())

    def finish(self) -> tuple[Stance, ...]:
        """All stances, in order; the last one perhaps has not ended."""
        self._close(ended=False)
        return tuple(self._over)

    def _close(self, *, ended: bool) -> None:
        if not self._pieces:
            return
        t_ns, grf_n = (np.concatenate(column) for column in zip(*self._pieces, strict=True))
        self._pieces = []
        there = np.isfinite(grf_n)
        known_n, known_ns = grf_n[there], t_ns[there]
        peak = int(np.argmax(known_n)) if len(known_n) else -1
        self._over.append(
            Stance(
                begin_t_ns=int(t_ns[0]),
                end_t_ns=int(t_ns[-1]),
                peak_n=float(known_n[peak]) if len(known_n) else float("nan"),
                peak_t_ns=int(known_ns[peak]) if len(known_n) else int(t_ns[0]),
                impulse_ns=float(np.trapezoid(known_n, (known_ns - t_ns[0]) * 1e-9)),
                unknown_frames=int((~there).sum()),
                begun=self._begun,
                ended=ended,
            )
        )
